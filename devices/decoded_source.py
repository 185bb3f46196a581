"""Sources whose records come out of bytes, which can be tapped before they are decoded."""

from __future__ import annotations

from collections.abc import Callable

from devices.codec import Codec, as_bytes
from devices.ledger import Ledger
from devices.ring import Gap, Piece
from devices.source import Batch, Source
from devices.statistics import Stats


class DecodedSource(Source):
    """What live and recorded streams have in common, so that both decode alike.

    Parameters
    ----------
    codec : Codec
    ledger : Ledger
        Where the pieces have been entered as unread.
    """

    def __init__(self, codec: Codec, ledger: Ledger) -> None:
        self.codec = codec
        self.tap: Callable[[Piece], None] | None = None
        """Called with every piece right before it is decoded."""
        self._ledger = ledger
        self._state = codec.start

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing beyond what `stats` reports; False for a recording that was
        cut or repaired.
        """
        return True

    def _decode_piece(self, piece: Piece) -> Batch:
        """Hand a piece to the tap and decode it."""
        if self.tap is not None:
            self.tap(piece)
        has_gap = piece.gap is not Gap.NONE
        # An instrument that began anew counts from zero again, so that what the decoder remembers
        # is wrong.
        if piece.gap is Gap.RESTART:
            self._state = self.codec.start
        found = self.codec.decode(as_bytes(piece.data), self._state, has_gap)
        self._state = found.state
        first = self._ledger.stats.delivered
        self._ledger.deliver(len(found.records), found.malformed)
        return Batch(found.records, first, has_gap, piece.received_at, piece.taken_at)
