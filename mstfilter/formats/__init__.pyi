from mstfilter.formats.bag import Bag as Bag
from mstfilter.formats.bop import Bop as Bop
from mstfilter.formats.dsr import Dsr as Dsr
from mstfilter.formats.folder import RecordingFolder as RecordingFolder, open_recording as open_recording
from mstfilter.formats.interfaces import Format as Format
from mstfilter.formats.paired_images import PairedImages as PairedImages, open_paired as open_paired
from mstfilter.formats.pauses import (
    At as At,
    Ends as Ends,
    Every as Every,
    Listed as Listed,
    PauseRule as PauseRule,
    pauses_from_text as pauses_from_text,
)
from mstfilter.formats.redwood import Redwood as Redwood
from mstfilter.formats.still import Still as Still
from mstfilter.formats.tum import Tum as Tum
from mstfilter.formats.writer import (
    RecordingWriter as RecordingWriter,
    check_writable as check_writable,
    save as save,
)
