"""Shots to clouds while they come: stages side by side, little held between them, every latency measured."""

from tofclip.sequences.streaming.channel import Policy
from tofclip.sequences.streaming.pipeline import StreamedCloud, stream_clouds
from tofclip.sequences.streaming.stages import Passage, Stage, in_stages

__all__ = ["Passage", "Policy", "Stage", "StreamedCloud", "in_stages", "stream_clouds"]
