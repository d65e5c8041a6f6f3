"""The particle filter itself; knows nothing of images, voxels or robots."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampler",
    "trigger": "Trigger",
    "size": "Size",
    "similarity": "Similarity",
    "equivalence": "Equivalence",
}
__components__ = {
    "resampler": {
        "multinomial": "Multinomial",
        "residual": "Residual",
        "stratified": "Stratified",
        "systematic": "Systematic",
        "ssp": "Ssp",
        "killing": "Killing",
        "largest_weights": "LargestWeights",
        "fearnhead_clifford": "FearnheadClifford",
        "clusters": "ClusterStratified",
        "kdpp": "KDpp",
        "greedy_diverse": "GreedyDiverse",
        "coalesced": "Coalesced",
        "tempered": "Tempered",
        "shuffled": "Shuffled",
        "keep_weights": "KeepWeights",
    },
    "trigger": {"always": "Always", "ess": "EssBelow", "every": "EveryKth", "never": "Never"},
    "size": {"fixed": "Fixed", "kld": "Kld"},
    "similarity": {"gaussian": "Gaussian"},
    "equivalence": {"bins": "Bins", "exact": "ExactEquality"},
}
