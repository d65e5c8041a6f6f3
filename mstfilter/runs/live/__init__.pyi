from mstfilter.runs.live.folder import filter_folder as filter_folder
from mstfilter.runs.live.stream import Pause as Pause, Stream as Stream
