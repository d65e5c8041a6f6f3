from mstfilter.training.border import BorderTraining as BorderTraining
from mstfilter.training.border_data import BorderSamples as BorderSamples
from mstfilter.training.completion import CompletionTraining as CompletionTraining
from mstfilter.training.completion_data import (
    Samples as Samples,
    read_samples as read_samples,
    scene_samples as scene_samples,
    write_samples as write_samples,
)
from mstfilter.training.loop import Training as Training, run_training as run_training
from mstfilter.training.shapes import HELD_OUT as HELD_OUT, TRAINED as TRAINED
