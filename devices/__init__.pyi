# The public names of this package and their homes; they are imported on first use.

from .codec import Codec as Codec
from .codec import DecodeResult as DecodeResult
from .ledger import Stats as Stats
from .registry import DiscoveredInstrument as DiscoveredInstrument
from .registry import discover as discover
from .registry import open as open  # noqa: A004 - the name users type
from .source import Batch as Batch
from .source import Info as Info
from .source import Source as Source
from .transients import read_transient as read_transient
