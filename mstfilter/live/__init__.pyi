from mstfilter.live.folder import filter_folder as filter_folder
from mstfilter.live.stream import Pause as Pause, Stream as Stream
