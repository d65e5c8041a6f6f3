from mstfilter.smc.branching import Branching as Branching
from mstfilter.smc.codecs import ArrayCodec as ArrayCodec
from mstfilter.smc.collectors import (
    collect as collect,
    ess as ess,
    log_evidence as log_evidence,
    mean as mean,
    unique_ancestors as unique_ancestors,
    weight_entropy as weight_entropy,
)
from mstfilter.smc.continuous import Normal as Normal, Student as Student, Uniform as Uniform
from mstfilter.smc.discrete import Bernoulli as Bernoulli, Categorical as Categorical, Poisson as Poisson
from mstfilter.smc.fields import number as number, part as part
from mstfilter.smc.filters import (
    PriorityLookahead as PriorityLookahead,
    auxiliary as auxiliary,
    guided as guided,
    resample_move as resample_move,
)
from mstfilter.smc.interfaces import (
    Codec as Codec,
    DensityTransition as DensityTransition,
    Lookahead as Lookahead,
    Proposal as Proposal,
    Rejuvenation as Rejuvenation,
    Resampler as Resampler,
    Size as Size,
    Transition as Transition,
    Trigger as Trigger,
    Update as Update,
)
from mstfilter.smc.kept_weights import KeepWeights as KeepWeights
from mstfilter.smc.many import run_many as run_many
from mstfilter.smc.particle_filter import ParticleFilter as ParticleFilter
from mstfilter.smc.population import (
    Candidates as Candidates,
    Population as Population,
    log_mean_exp as log_mean_exp,
    normalise as normalise,
)
from mstfilter.smc.program_runs import per_particle as per_particle
from mstfilter.smc.program_sites import observe as observe, sample as sample, switch as switch
from mstfilter.smc.programs import (
    Program as Program,
    ProgramLookahead as ProgramLookahead,
    ProgramMove as ProgramMove,
)
from mstfilter.smc.rao_blackwell import (
    ConditionallyLinear as ConditionallyLinear,
    Linear as Linear,
    rao_blackwellised as rao_blackwellised,
)
from mstfilter.smc.rejuvenation import RandomWalkMove as RandomWalkMove
from mstfilter.smc.resampling import (
    Always as Always,
    EssBelow as EssBelow,
    Every as Every,
    Multinomial as Multinomial,
    Never as Never,
    Residual as Residual,
    Stratified as Stratified,
    Systematic as Systematic,
)
from mstfilter.smc.resampling_clusters import ClusterStratified as ClusterStratified
from mstfilter.smc.resampling_dpp import KDpp as KDpp
from mstfilter.smc.resampling_greedy import GreedyDiverse as GreedyDiverse
from mstfilter.smc.resampling_optimal import FearnheadClifford as FearnheadClifford
from mstfilter.smc.resampling_rounding import Killing as Killing, ResidualSystematic as ResidualSystematic, Ssp as Ssp
from mstfilter.smc.resampling_wrappers import (
    Coalesced as Coalesced,
    Shuffled as Shuffled,
    Tempered as Tempered,
    coalesce as coalesce,
)
from mstfilter.smc.similarity import (
    Bins as Bins,
    Equivalence as Equivalence,
    Exact as Exact,
    Gaussian as Gaussian,
    Similarity as Similarity,
    as_matrix as as_matrix,
    first_seen as first_seen,
)
from mstfilter.smc.sizes import Fixed as Fixed, Kld as Kld
from mstfilter.smc.smoothing import (
    backward_paths as backward_paths,
    fixed_lag as fixed_lag,
    genealogy as genealogy,
    keep as keep,
)
from mstfilter.smc.state import Info as Info, State as State
from mstfilter.smc.state_space import (
    Dynamics as Dynamics,
    Prior as Prior,
    StateSpaceModel as StateSpaceModel,
    bootstrap as bootstrap,
    linear_gaussian as linear_gaussian,
)
from mstfilter.smc.streams import Key as Key, child as child, key_of as key_of
from mstfilter.smc.updates import Reweight as Reweight, union as union
from mstfilter.smc.vectors import CrossVectors as CrossVectors, ProjectOnto as ProjectOnto
from mstfilter.smc.watch import Watch as Watch, telling as telling
