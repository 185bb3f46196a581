"""Shots to clouds while they come: stages side by side, little held between them, every latency
measured.
"""

from tofclip.sequences.streaming.channel import Policy
from tofclip.sequences.streaming.pipeline import StreamedCloud, stream_clouds
from tofclip.sequences.streaming.stages import Stage, StreamItem, run_stages

__all__ = ["Policy", "Stage", "StreamItem", "StreamedCloud", "run_stages", "stream_clouds"]
