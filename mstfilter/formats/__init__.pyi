from mstfilter.formats.bag import Bag as Bag
from mstfilter.formats.folder import (
    RecordingFolder as RecordingFolder,
    RecordingWriter as RecordingWriter,
    save_recording as save_recording,
)
from mstfilter.formats.images import (
    read_depth as read_depth,
    read_labels as read_labels,
    read_rgb as read_rgb,
    write_image as write_image,
)
from mstfilter.formats.known_layout import KnownLayout as KnownLayout
from mstfilter.formats.pairs import PairedImages as PairedImages
from mstfilter.formats.pauses import At as At, Ends as Ends, EveryNth as EveryNth, Settled as Settled, Still as Still
from mstfilter.formats.redwood import Redwood as Redwood
from mstfilter.formats.sources import (
    detect_format as detect_format,
    open_format as open_format,
    open_recording as open_recording,
)
from mstfilter.formats.tum import Tum as Tum
from mstfilter.formats.video import (
    KnownWorld as KnownWorld,
    RecordingFormat as RecordingFormat,
    Video as Video,
    VideoFormat as VideoFormat,
)
from mstfilter.scene import PauseRule as PauseRule
