"""Is a recording what was written? And what can be saved if it is not."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from devices.recording.read import Block, BlockKind, BlockReader, Damage, Ending, Recording
from devices.recording.write import RecordingWriter
from devices.source import Codec, Gap, Piece, Stats, as_bytes
from tofclip.errors import FileFormatError


@dataclass
class Findings:
    """What is in a recording."""

    bytes: int = 0  # of the instrument, as they came
    # sound blocks; records that decode, and records that do not; places where the recording says
    # that something is missing
    blocks: int = 0
    # sound blocks; records that decode, and records that do not; places where the recording says
    # that something is missing
    records: int = 0
    # sound blocks; records that decode, and records that do not; places where the recording says
    # that something is missing
    malformed: int = 0
    # sound blocks; records that decode, and records that do not; places where the recording says
    # that something is missing
    gaps: int = 0
    # what is not what was written. Bytes behind the last block count as well
    damaged_blocks: int = 0
    # what is not what was written. Bytes behind the last block count as well
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
        """Whether everything in the file is what was written, and the accounts agree with the
        records.
        """
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
        """Return everything by name."""
        return {"sound": self.is_sound, **asdict(self)}


def verify(path: Path) -> Findings:
    """Read a recording from end to end, decode it, and compare it with its checksums and its
    accounts.

    Memory: one block and its records.
    """
    with Recording(path) as recording:
        inspector = _Inspector(recording.codec)
        for entry in recording.blocks:
            inspector.inspect(recording.blocks, entry)
        return inspector.findings


def repair(path: Path, out: Path) -> Findings:
    """Copy every sound block of a recording into a new one; gaps are marked where something had to
    be left out, and the copy of a damaged or truncated recording never claims to be complete.

    `path`: also a recording of version 0.1.0; `out`: replaced if it exists. Returns of `path`.
    """
    with Recording(path) as recording:
        inspector = _Inspector(recording.codec)
        writer = RecordingWriter(out, recording.head, overwrite=True)
        try:
            for entry in recording.blocks:
                piece = inspector.inspect(recording.blocks, entry)
                if piece is not None:
                    writer.add(piece)
            findings = inspector.findings
            writer.finish(inspector.stats, findings.fault, findings.complete)
        finally:
            writer.close()
    return inspector.findings


class _Inspector:
    """Looks at one block after the other."""

    def __init__(self, codec: Codec) -> None:
        self.findings = Findings()
        self._codec = codec
        self._state = codec.start
        self._gap = Gap.NONE
        self._next_number = 0
        self._holes = 0  # damaged stretches since the last sound header
        self._is_missing_data = False

    @property
    def stats(self) -> Stats:
        """Accounts of what was found, for a recording without its own."""
        found = self.findings
        return Stats(found.records + found.malformed, found.records, malformed=found.malformed)

    def inspect(self, blocks: BlockReader, entry: Block | Damage) -> Piece | None:
        """Enter a block into the findings; return its piece if it is a sound one."""
        if isinstance(entry, Damage):
            self._holes += 1
            self._count_damage(entry.length)
            self.findings.cut_bytes += entry.length if entry.is_cut else 0
            return None
        self._count_missing(entry)
        try:
            payload = blocks.read_payload(entry)
        except FileFormatError:
            self._count_damage(
                entry.end - entry.position, is_data=entry.header.kind is BlockKind.PIECE
            )
            return None
        self.findings.blocks += 1
        if entry.header.kind is BlockKind.END:
            self._read_ending(Ending.from_json(payload, blocks.path))
        return self._decode_piece(entry, payload) if entry.header.kind is BlockKind.PIECE else None

    def _count_missing(self, block: Block) -> None:
        """Find whole blocks that are not there, by the numbers of those that are."""
        if not block.header.is_legacy:
            # Each damaged stretch stands for one block at least, which must not be counted twice.
            missing = block.header.number - self._next_number - self._holes
            if missing > 0:
                self._count_damage(0)
                self.findings.damaged_blocks += missing - 1
            self._next_number = block.header.number + 1
        self._holes = 0

    def _count_damage(self, length: int, is_data: bool = True) -> None:
        self.findings.damaged_blocks += 1
        self.findings.damaged_bytes += length
        if is_data:
            self._gap = Gap.LOSS
            self._is_missing_data = True
            self.findings.complete = False

    def _read_ending(self, ending: Ending) -> None:
        self.findings.complete = ending.is_complete and not self._is_missing_data
        self.findings.stats = ending.stats
        self.findings.fault = ending.fault

    def _decode_piece(self, block: Block, payload: bytes) -> Piece:
        piece = Piece(payload, block.header.records, max(block.header.gap, self._gap))
        self._gap = Gap.NONE
        if piece.gap is Gap.RESTART:
            self._state = self._codec.start
        found = self._codec.decode(as_bytes(payload), self._state, piece.gap is not Gap.NONE)
        self._state = found.state
        self.findings.bytes += len(payload)
        self.findings.records += len(found.records)
        self.findings.malformed += found.malformed
        self.findings.gaps += piece.gap is not Gap.NONE
        return piece
