# The public names of this package and their homes; they are imported on first use.

from .registry import DiscoveredInstrument as DiscoveredInstrument
from .registry import discover as discover
from .registry import open as open  # noqa: A004 - the name users type
from .registry import register_source as register_source
from .source import Batch as Batch
from .source import Codec as Codec
from .source import DecodeResult as DecodeResult
from .source import Info as Info
from .source import Source as Source
from .source import Stats as Stats
from .transients import read_transient as read_transient
