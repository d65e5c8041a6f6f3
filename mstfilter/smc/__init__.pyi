from mstfilter.smc.checkpoint import ArrayCodec as ArrayCodec, load_state as load_state, save_state as save_state
from mstfilter.smc.components import (
    Always as Always,
    Bins as Bins,
    Branching as Branching,
    EssBelow as EssBelow,
    Every as Every,
    ExactEquality as ExactEquality,
    Kld as Kld,
    Never as Never,
    Reweight as Reweight,
    first_seen as first_seen,
)
from mstfilter.smc.diverse_resampling import (
    Chopthin as Chopthin,
    ClusterStratified as ClusterStratified,
    FearnheadClifford as FearnheadClifford,
    Gaussian as Gaussian,
)
from mstfilter.smc.filter import ParticleFilter as ParticleFilter
from mstfilter.smc.history import (
    History as History,
    circular_mean as circular_mean,
    collect as collect,
    covariance as covariance,
    ess as ess,
    log_evidence as log_evidence,
    mean as mean,
    particles as particles,
    quantiles as quantiles,
    resampled as resampled,
    unique_ancestors as unique_ancestors,
    variance as variance,
    weights as weights,
)
from mstfilter.smc.inference.additive import additive as additive
from mstfilter.smc.inference.conditional import conditional_path as conditional_path, path_log_prob as path_log_prob
from mstfilter.smc.inference.diagnostics import (
    RunVariance as RunVariance,
    energy_distance as energy_distance,
    run_variance as run_variance,
)
from mstfilter.smc.inference.metropolis import RandomWalkMove as RandomWalkMove
from mstfilter.smc.inference.parameters import (
    Chains as Chains,
    ensemble as ensemble,
    particle_gibbs as particle_gibbs,
    pmmh as pmmh,
)
from mstfilter.smc.inference.samplers import Sampled as Sampled, ibis as ibis, tempering as tempering
from mstfilter.smc.inference.smc2 import smc2 as smc2
from mstfilter.smc.inference.smoothing import (
    Record as Record,
    backward_paths as backward_paths,
    fixed_lag as fixed_lag,
    genealogy as genealogy,
    keep as keep,
)
from mstfilter.smc.inference.two_filter import two_filter as two_filter
from mstfilter.smc.inputs import WithInput as WithInput
from mstfilter.smc.interfaces import (
    Codec as Codec,
    Component as Component,
    DensityTransition as DensityTransition,
    Distribution as Distribution,
    Equivalence as Equivalence,
    Info as Info,
    Infos as Infos,
    Lookahead as Lookahead,
    Proposal as Proposal,
    Rejuvenation as Rejuvenation,
    Resampler as Resampler,
    Similarity as Similarity,
    Size as Size,
    State as State,
    Transition as Transition,
    Trigger as Trigger,
    Update as Update,
    WeightResampler as WeightResampler,
)
from mstfilter.smc.models.combined import Mixture as Mixture, Product as Product, Truncated as Truncated
from mstfilter.smc.models.distributions import (
    Bernoulli as Bernoulli,
    Categorical as Categorical,
    Joint as Joint,
    MultivariateNormal as MultivariateNormal,
    Normal as Normal,
    Student as Student,
    Uniform as Uniform,
    as_distribution as as_distribution,
)
from mstfilter.smc.models.exact import (
    Kalman as Kalman,
    Marginals as Marginals,
    forward_backward as forward_backward,
    hidden_markov as hidden_markov,
    kalman_filter as kalman_filter,
    linear_gaussian as linear_gaussian,
)
from mstfilter.smc.models.families import (
    Beta as Beta,
    Binomial as Binomial,
    Dirichlet as Dirichlet,
    Gamma as Gamma,
    LogNormal as LogNormal,
    Poisson as Poisson,
    VonMises as VonMises,
)
from mstfilter.smc.models.gaussian import (
    ConditionallyLinear as ConditionallyLinear,
    Linear as Linear,
    nonlinear_gaussian as nonlinear_gaussian,
    rao_blackwellised as rao_blackwellised,
    ukf_proposal as ukf_proposal,
)
from mstfilter.smc.models.programs.filters import Program as Program
from mstfilter.smc.models.programs.sites import observe as observe, sample as sample, switch as switch
from mstfilter.smc.models.quasi import SobolGenerator as SobolGenerator, sqmc as sqmc
from mstfilter.smc.models.state_space import (
    Dynamics as Dynamics,
    Prior as Prior,
    PriorityLookahead as PriorityLookahead,
    StateSpaceModel as StateSpaceModel,
    auxiliary as auxiliary,
    bootstrap as bootstrap,
    guided as guided,
    resample_move as resample_move,
)
from mstfilter.smc.population import (
    Candidates as Candidates,
    Population as Population,
    as_matrix as as_matrix,
    log_mean_exp as log_mean_exp,
    normalise as normalise,
    union as union,
)
from mstfilter.smc.resampling import (
    Killing as Killing,
    LargestWeights as LargestWeights,
    Multinomial as Multinomial,
    Residual as Residual,
    Ssp as Ssp,
    Stratified as Stratified,
    Systematic as Systematic,
)
from mstfilter.smc.running import run_many as run_many
from mstfilter.smc.streams import Key as Key, child as child, key_of as key_of
from mstfilter.smc.wrapped_resampling import (
    Coalesced as Coalesced,
    KeepWeights as KeepWeights,
    ResamplerWrapper as ResamplerWrapper,
    Shuffled as Shuffled,
    Sized as Sized,
    Sorted as Sorted,
    Tempered as Tempered,
    coalesce as coalesce,
)
