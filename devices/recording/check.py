"""Is a recording what was written? And what can be saved if it is not."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

from devices.codec import Codec, as_bytes
from devices.recording.blocks import BlockKind
from devices.recording.reader import (
    Block,
    BlockReader,
    Damage,
    Recording,
    build_codec_from_head,
    parse_head,
)
from devices.recording.writer import RecordingWriter
from devices.ring import Gap, Piece
from devices.statistics import Stats
from tofclip.errors import FileFormatError
from tofclip.storage import translate_read_errors

BUFFER_BYTES = 1 << 22


@dataclass
class Findings:
    """What is in a recording.

    Parameters
    ----------
    bytes : int
        Of the instrument, as they came.
    blocks, records, malformed, gaps : int
        Sound blocks; records that decode, and such that do not; places where the recording says
        that something is missing.
    damaged_blocks, damaged_bytes : int
        What is not what was written. Bytes behind the last block count as well.
    complete : bool
        The recording was ended in order. One of a program that was killed is not, and good up to
        its end.
    stats : mapping
        The accounts at the end, empty where it was not ended in order.
    fault : str
        What ended it if it was not meant to end.
    """

    bytes: int = 0
    blocks: int = 0
    records: int = 0
    malformed: int = 0
    gaps: int = 0
    damaged_blocks: int = 0
    damaged_bytes: int = 0
    complete: bool = False
    stats: dict[str, int] = field(default_factory=dict)
    fault: str = ""

    @property
    def is_sound(self) -> bool:
        """Whether everything in the file is what was written, and the accounts agree with the
        records.
        """
        if self.damaged_blocks or not self.stats:
            return not self.damaged_blocks
        reported = Stats(**self.stats)
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

    Raises
    ------
    StorageError, FileFormatError
        FileFormatError where the file cannot be opened as a recording at all.
    """
    with Recording(path) as recording:
        survey = _Inspector(recording.codec)
        for entry in recording.blocks:
            survey.inspect(recording.blocks, entry)
        return survey.findings


def repair(path: Path, out: Path) -> Findings:
    """Copy every sound block of a recording into a new one; gaps are marked where something had to
    be left out.

    The file need not be readable as HDF5: its blocks are found by their own marks and checksums.

    Raises
    ------
    StorageError, FileFormatError
        FileFormatError where not even the block that describes the instrument is left.
    """
    with translate_read_errors(path), open(path, "rb", buffering=BUFFER_BYTES) as file:

        def fetch(position: int, length: int) -> bytes:
            file.seek(position)
            return file.read(length)

        blocks = BlockReader(path, fetch, os.fstat(file.fileno()).st_size)
        return _copy_blocks(blocks, out)


def _copy_blocks(blocks: BlockReader, out: Path) -> Findings:
    entries = iter(blocks)
    head = next(
        (
            entry
            for entry in entries
            if isinstance(entry, Block) and entry.header.kind is BlockKind.HEAD
        ),
        None,
    )
    if head is None:
        raise FileFormatError(
            blocks.path, "holds no sound description of its instrument; nothing can be saved"
        )
    described = parse_head(blocks.read_payload(head), blocks.path)
    survey = _Inspector(build_codec_from_head(described, blocks.path))
    writer = RecordingWriter(out, described)
    try:
        for entry in entries:
            piece = survey.inspect(blocks, entry)
            if piece is not None:
                writer.add(piece)
        writer.finish(survey.stats, survey.findings.fault)
    finally:
        writer.close()
    return survey.findings


class _Inspector:
    """Looks at one block after the other."""

    def __init__(self, codec: Codec) -> None:
        self.findings = Findings()
        self._codec, self._state = codec, codec.start
        self._gap = Gap.NONE

    @property
    def stats(self) -> Stats:
        """Accounts of what was found, for a recording without its own."""
        found = self.findings
        return Stats(found.records + found.malformed, found.records, malformed=found.malformed)

    def inspect(self, blocks: BlockReader, entry: Block | Damage) -> Piece | None:
        """Enter a block into the findings; return its piece if it is a sound one."""
        if isinstance(entry, Damage):
            self._count_damage(entry.length)
            return None
        try:
            payload = blocks.read_payload(entry)
        except FileFormatError:
            self._count_damage(entry.end - entry.position)
            return None
        self.findings.blocks += 1
        if entry.header.kind is BlockKind.END:
            self._read_ending(payload)
        return self._decode_piece(entry, payload) if entry.header.kind is BlockKind.PIECE else None

    def _count_damage(self, length: int) -> None:
        self.findings.damaged_blocks += 1
        self.findings.damaged_bytes += length
        self._gap = Gap.LOSS

    def _read_ending(self, payload: bytes) -> None:
        ending = json.loads(payload)
        self.findings.complete = True
        self.findings.stats, self.findings.fault = ending["stats"], ending["fault"]

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
