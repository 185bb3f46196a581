"""Is a recording what was written? And what can be saved if it is not."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from devices.recording.read import BlockKind, Damage, Ending, Recording
from devices.recording.write import RecordingWriter
from devices.source import Gap, Piece, Stats, as_bytes
from tofclip.errors import FileFormatError


@dataclass
class Findings:
    """What is in a recording."""

    bytes: int = 0  # of the instrument, as they came
    blocks: int = 0  # sound ones
    records: int = 0  # that decode
    malformed: int = 0  # records that do not
    gaps: int = 0  # places where the recording says that something is missing
    # what is not what was written. Bytes behind the last block count as well
    damaged_blocks: int = 0
    damaged_bytes: int = 0
    # of these, a last block that was never finished, because the program was killed or the file
    # truncated: no damage to what is before it
    cut_bytes: int = 0
    # the recording was ended in order, and nothing of it is missing. False for that of a program
    # that was killed, although it is good up to its end, and for a repaired copy of a damaged or
    # truncated recording, however often it is copied
    complete: bool = False
    # the accounts at the end, empty where it was not ended in order
    stats: dict[str, int] = field(default_factory=dict)
    fault: str = ""  # what ended it if it was not meant to end

    @property
    def is_sound(self) -> bool:
        """Whether all blocks are what was written, and the accounts agree with the records."""
        damaged_blocks = self.damaged_blocks - (1 if self.cut_bytes else 0)
        if damaged_blocks or not self.stats:
            return not damaged_blocks
        known = {name: self.stats.get(name, 0) for name in Stats().as_dict()}
        reported = Stats(**known)
        # A piece that was being decoded when the recording was interrupted is in the file and in
        # the accounts as unread; a record of which the end never came is in the accounts only.
        most = reported.delivered + reported.malformed + reported.unread
        return reported.delivered <= self.records and self.records + self.malformed <= most

    def as_dict(self) -> dict[str, object]:
        return {"sound": self.is_sound, **asdict(self)}


def verify(path: Path) -> Findings:
    """Read a recording from end to end, decode it, and compare it with its checksums and its
    accounts. Memory: one block and its records.
    """
    with Recording(path) as recording:
        return _inspect(recording, lambda piece: None)


def repair(path: Path, out: Path) -> Findings:
    """Copy every sound block of a recording into a new one; gaps are marked where something had to
    be left out, and the copy of a damaged or truncated recording never claims to be complete.
    """
    with (
        Recording(path) as recording,
        contextlib.closing(RecordingWriter(out, recording.head, overwrite=True)) as writer,
    ):
        found = _inspect(recording, writer.add)
        acquired = found.records + found.malformed
        stats = Stats(acquired, found.records, malformed=found.malformed)
        writer.finish(stats, found.fault, found.complete)
    return found


def _inspect(recording: Recording, save: Callable[[Piece], None]) -> Findings:
    """Look at one block after the other, and save every sound piece, with the gaps before it."""
    found, codec, blocks = Findings(), recording.codec, recording.blocks
    state, gap, is_missing = codec.start, Gap.NONE, False
    next_number = holes = 0  # `holes`: damaged stretches since the last sound header
    for entry in blocks:
        payload, is_lost = None, False
        if isinstance(entry, Damage):
            holes, is_lost = holes + 1, True
            found.damaged_blocks += 1
            found.damaged_bytes += entry.length
            found.cut_bytes += entry.length if entry.is_cut else 0
        else:
            if not entry.is_legacy:
                # Whole blocks may be gone. Each damaged stretch stands for one at least, which must
                # not be counted twice.
                missing = max(0, entry.number - next_number - holes)
                found.damaged_blocks += missing
                is_lost, next_number = missing > 0, entry.number + 1
            holes = 0
            try:
                payload = blocks.read_payload(entry)
                found.blocks += 1
            except FileFormatError:
                found.damaged_blocks += 1
                found.damaged_bytes += entry.end - entry.position
                is_lost |= entry.kind is BlockKind.PIECE
        if is_lost:
            gap, is_missing, found.complete = Gap.LOSS, True, False
        if isinstance(entry, Damage) or payload is None:
            continue
        if entry.kind is BlockKind.END:
            ending = Ending.from_json(payload, blocks.path)
            found.complete = ending.is_complete and not is_missing
            found.stats, found.fault = ending.stats, ending.fault
        elif entry.kind is BlockKind.PIECE:
            piece = Piece(payload, entry.records, max(entry.gap, gap))
            start = codec.start if piece.gap is Gap.RESTART else state
            decoded = codec.decode(as_bytes(payload), start, piece.gap is not Gap.NONE)
            state, gap = decoded.state, Gap.NONE
            found.bytes += len(payload)
            found.records += len(decoded.records)
            found.malformed += decoded.malformed
            found.gaps += piece.gap is not Gap.NONE
            save(piece)
    return found
