"""Writing recordings."""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic, time_ns
from typing import Any

from devices.codec import Codec
from devices.recording.appendable_file import AppendableFile
from devices.recording.blocks import BlockHeader, BlockKind
from devices.ring import Piece
from devices.source import Info
from devices.statistics import Stats
from tofclip.storage import Record

FLUSH_INTERVAL_S = 0.25
"""At most this much of a recording is lost with a killed program."""

FLUSH_BYTES = 32 << 20


def make_head(
    codec: Codec, info: Info, calibration: Record | None, provenance: dict[str, Any]
) -> Record:
    """Describe an instrument: all of a recording that is known before the first piece."""
    attributes = {
        "codec": codec.name,
        "codec_settings": json.dumps(dict(codec.settings)),
        "info": json.dumps(info.as_dict()),
    }
    children = {} if calibration is None else {"calibration": calibration}
    return Record("recording", {}, attributes, children, provenance)


class RecordingWriter:
    """A recording under way.

    What was flushed is safe from anything that happens to this program. The system may take longer
    to bring it to the disk: only `close` waits for that.

    Parameters
    ----------
    path : Path
    head : Record
        Made by `make_head`.
    """

    def __init__(self, path: Path, head: Record) -> None:
        self.bytes_flushed = 0
        """Payload of the pieces that a reader of the file sees by now."""
        self._pending = 0
        self._file = AppendableFile(
            path,
            head,
            lambda image: BlockHeader.of(BlockKind.HEAD, image, time_ns()).pack() + image,
        )
        self.flush()

    def add(self, piece: Piece) -> None:
        """Append a piece; it is flushed soon."""
        self._append(
            BlockHeader.of(BlockKind.PIECE, piece.data, time_ns(), piece.records, piece.gap),
            piece.data,
        )
        self._pending += len(piece.data)
        if self._pending >= FLUSH_BYTES or monotonic() > self._flushed_at + FLUSH_INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """Let readers of the file see everything up to now."""
        self._file.commit()
        self.bytes_flushed += self._pending
        self._pending = 0
        self._flushed_at = monotonic()

    def finish(self, stats: Stats, fault: str = "") -> None:
        """Append the accounts, and what ended the recording if it was not meant to end."""
        text = json.dumps({"stats": stats.as_dict(), "fault": fault}).encode()
        self._append(BlockHeader.of(BlockKind.END, text, time_ns()), text)
        self.flush()

    def close(self) -> None:
        """Hand everything to the disk; closing twice is fine."""
        self._file.close()

    def _append(self, header: BlockHeader, payload: bytes) -> None:
        self._file.append(header.pack(), payload)
