from mstfilter.training.completion import (
    CompletionTraining as CompletionTraining,
    completion_settings as completion_settings,
    train_completion as train_completion,
)
from mstfilter.training.completion_data import (
    Samples as Samples,
    read_samples as read_samples,
    scene_samples as scene_samples,
    write_samples as write_samples,
)
from mstfilter.training.shapes import HELD_OUT as HELD_OUT, TRAINED as TRAINED
