"""Components with one fault each. None of these kinds of fault is in tests/mst/testing.

`FAULTS` has for each fault the kind of its component, and a function without arguments that makes the component.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from entries import (
    Entries,
    exact_ar1,
    exact_moved,
    exact_prior,
    exact_rejuvenated,
    exact_weighted,
    plane_example,
    scene_example,
    words_example,
)
from scipy import ndimage, stats
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.completion import Completer, Extrude
from mstfilter.mst.segmentation import BoundaryModel, ColourDepthBoundary
from mstfilter.mst.tracking import (
    MaskTracker,
    MstRule,
    Registration,
    SmallGicp,
    TrackingTransition,
)
from mstfilter.scene import FreeSpace, Hypothesis
from mstfilter.smc import (
    Codec,
    DensityTransition,
    Equivalence,
    Lookahead,
    Normal,
    Population,
    Proposal,
    Rejuvenation,
    Resampler,
    Similarity,
    Size,
    Transition,
    Trigger,
    Update,
    WeightResampler,
    log_mean_exp,
    normalise,
    union,
)

FAULTS = Entries()
planted = FAULTS.add


def draw(rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
    """Independent draws by weight."""
    cumulative = np.cumsum(weights)
    return np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")


# --- resamplers ---------------------------------------------------------------------------------------------------
@planted("resampler", "the points reach from 0 to 1 inclusive, so that the last is too likely")
class PointsToTheEnd(WeightResampler):
    def select(self, rng, log_weights, n):
        points = np.linspace(0, 1, n) * (1 - 1 / n) + rng.random() / (n + 1)
        cumulative = np.cumsum(normalise(log_weights))
        return np.minimum(
            np.searchsorted(cumulative, points, side="right"), np.flatnonzero(log_weights > -np.inf)[-1]
        ), None


@planted("resampler", "a Metropolis chain of five steps has not forgotten its start")
class ShortChain(WeightResampler):
    def select(self, rng, log_weights, n):
        at = np.resize(np.flatnonzero(log_weights > -np.inf), n)
        for _ in range(5):
            new = rng.integers(len(log_weights), size=n)
            at = np.where(np.log1p(-rng.random(n)) < log_weights[new] - log_weights[at], new, at)
        return at, None


@planted("resampler", "rejection by the largest of the first four weights")
class RejectionByAFew(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        top = max(weights[:4].max(), 1e-12)
        out = np.empty(n, int)
        for k in range(n):
            while True:
                i = rng.integers(len(weights))
                if rng.random() * top < weights[i]:
                    break
            out[k] = i
        return out, None


@planted("resampler", "the rest is drawn by the weights, not by what the whole copies leave")
class RestByWeights(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        copies = np.floor(n * weights).astype(int)
        rest = draw(rng, weights, n - copies.sum())
        return np.concatenate([np.repeat(np.arange(len(weights)), copies), rest]), None


@planted("resampler", "the alias method compares the column's own uniform number again")
class AliasOneUniform(WeightResampler):
    def select(self, rng, log_weights, n):
        m = len(log_weights)
        share, alias = m * normalise(log_weights), np.arange(m)
        small, large = list(np.flatnonzero(share < 1)), list(np.flatnonzero(share >= 1))
        share = share.copy()
        while small and large:
            s, big = small.pop(), large.pop()
            alias[s] = big
            share[big] -= 1 - share[s]
            (small if share[big] < 1 else large).append(big)
        share[small + large] = 1.0
        u = rng.random(n)
        column = (u * m).astype(int)
        return np.where(u < share[column], column, alias[column]), None


@planted("resampler", "draws without replacement")
class WithoutReplacement(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        return rng.choice(len(weights), n, replace=n > (weights > 0).sum(), p=weights), None


@planted("resampler", "the points are fixed, the generator is never used")
class MidPoints(WeightResampler):
    def select(self, rng, log_weights, n):
        return np.searchsorted(np.cumsum(normalise(log_weights)), (np.arange(n) + 0.5) / n, side="right"), None


@planted("resampler", "the sum of the weights is kept, not their mean")
class KeepsTheSum(WeightResampler):
    def select(self, rng, log_weights, n):
        total = log_mean_exp(log_weights) + np.log(len(log_weights))
        return draw(rng, normalise(log_weights), n), np.full(n, total - np.log(n))


@planted("resampler", "heavy particles are kept and the others drawn, all at the threshold 1/n")
class ThresholdAtMean(WeightResampler):
    def select(self, rng, log_weights, n):
        weights, mean = normalise(log_weights), log_mean_exp(log_weights)
        heavy = np.flatnonzero(weights > 1 / n)[:n]
        light = np.where(weights > 1 / n, 0.0, weights)
        rest = draw(rng, light, n - len(heavy)) if light.sum() > 0 else np.resize(heavy, n - len(heavy))
        out = np.concatenate([heavy, rest])
        return out, mean + np.log(len(weights)) + np.log(np.maximum(weights[out], 1 / n))


@planted("resampler", "killed particles are replaced by any survivor, whatever its weight")
class KilledByAnySurvivor(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        if n != len(weights):
            return draw(rng, weights, n), None
        alive = rng.random(n) < weights / weights.max()
        return np.where(alive, np.arange(n), rng.choice(np.flatnonzero(alive), n)), None


@planted("resampler", "of two drawn particles the heavier is taken")
class Tournament(WeightResampler):
    def select(self, rng, log_weights, n):
        pairs = rng.choice(np.flatnonzero(log_weights > -np.inf), (n, 2))
        return np.where(log_weights[pairs[:, 0]] > log_weights[pairs[:, 1]], pairs[:, 0], pairs[:, 1]), None


@planted("resampler", "the seed of its generator is the whole part of a number below 1")
class SeedOfAFraction(WeightResampler):
    def select(self, rng, log_weights, n):
        own = np.random.default_rng(int(rng.random()))
        return draw(own, normalise(log_weights), n), None


@planted("resampler", "islands of four are resampled apart and keep equal weights")
class Islands(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        parts = np.array_split(np.arange(len(weights)), max(1, len(weights) // 4))
        parts = [part for part in parts if weights[part].sum() > 0]
        sizes = np.diff(np.linspace(0, n, len(parts) + 1).astype(int))
        return np.concatenate([part[draw(rng, weights[part], k)] for part, k in zip(parts, sizes, strict=True)]), None


@planted("resampler", "equal particles are first merged, then drawn as if each class had one weight")
class EqualCountOnce(Resampler):
    def resample(self, rng, population, n):
        _, first = np.unique(np.asarray(population.particles), return_index=True, axis=0)
        chosen = first[draw(rng, population.weights[first], n)]
        return population.select(chosen, np.full(n, population.log_mean_weight))


@planted("resampler", "a little noise is added to the particles (roughening)")
class Roughening(Resampler):
    def resample(self, rng, population, n):
        chosen = population.select(draw(rng, population.weights, n), np.full(n, population.log_mean_weight))
        return replace(chosen, particles=chosen.particles + 1e-3 * rng.standard_normal(chosen.particles.shape))


@planted("resampler", "the numbers of copies follow the squares of the weights")
class MassBySquares(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        copies = rng.multinomial(n, weights**2 / (weights**2).sum())
        return np.repeat(np.arange(len(weights)), copies), None


# --- transitions --------------------------------------------------------------------------------------------------
@planted("transition", "the steps are evenly spaced over the places")
class StepsByPlace(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        steps = np.linspace(-1, 1, len(x)).reshape(-1, *[1] * (x.ndim - 1))
        return population.moved(x + steps + 0.01 * rng.standard_normal(x.shape))


@planted("transition", "the noise of the first half is used again for the second")
class NoiseTwice(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        noise = rng.standard_normal((-(-len(x) // 2), *x.shape[1:]))
        return population.moved(0.9 * x + np.concatenate([noise, noise])[: len(x)])


@planted("transition", "the noise is sorted")
class SortedNoise(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        return population.moved(0.9 * x + np.sort(rng.standard_normal(x.shape), axis=0))


@planted("transition", "stratified noise: row k gets the k-th stratum")
class StratifiedNoise(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        u = (np.arange(len(x)) + rng.random(len(x))) / len(x)
        return population.moved(0.9 * x + stats.norm.ppf(u).reshape(-1, *[1] * (x.ndim - 1)))


@planted("transition", "the second axis gets the noise of the first, one row later", example=plane_example)
class OverlappingNoise(Transition):
    def predict(self, rng, population, observation):
        noise = rng.standard_normal(len(population) + 1)
        return population.moved(population.particles + np.stack([noise[:-1], noise[1:]], axis=1))


@planted("transition", "particles are drawn to their weighted mean")
class ShrinksToTheMean(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        mean = np.tensordot(population.weights, x, axes=1)
        return population.moved(mean + 0.95 * (x - mean) + 0.3 * rng.standard_normal(x.shape))


@planted("transition", "the noise is as large as the spread of the population")
class NoiseOfTheSpread(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        return population.moved(x + 0.5 * x.std() * rng.standard_normal(x.shape))


@planted("transition", "scipy draws from the global generator")
class ScipyGlobal(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        return population.moved(0.9 * x + stats.norm(scale=0.5).rvs(x.shape))


@planted("transition", "a generator of its own with a fixed seed, the given one is never used")
class OwnSeed(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        return population.moved(0.9 * x + np.random.default_rng(0).standard_normal(x.shape))


@planted("transition", "the weights are lost")
class LosesWeights(Transition):
    def predict(self, rng, population, observation):
        return Population(0.9 * population.particles + rng.standard_normal(population.particles.shape))


@planted("transition", "the speed grows with every call")
@dataclass(frozen=True)
class Accelerates(Transition):
    speed: list = field(default_factory=lambda: [0.0])

    def predict(self, rng, population, observation):
        self.speed[0] += 0.1
        return population.moved(
            population.particles + self.speed[0] + rng.standard_normal(population.particles.shape)
        )


@planted("transition", "the square root of a negative number")
class NanOfARoot(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        with np.errstate(invalid="ignore"):
            return population.moved(np.sqrt(x + 0.5) + 0.1 * rng.standard_normal(x.shape))


@planted(
    "transition",
    "noise (n,) is added to particles (n, 1)",
    example=lambda rng, n: (Population(rng.standard_normal((n, 1)), rng.standard_normal(n)), 0.4),
)
class BroadcastNoise(Transition):
    def predict(self, rng, population, observation):
        return population.moved(population.particles + rng.standard_normal(len(population)))


@planted("transition", "the guided move forgets the standard deviations in its weights", exact=exact_moved)
class ConstantsOfQ(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        mean, sd = 0.9 * x, 0.5
        if observation is not None:
            gain = 0.25 / (0.25 + 1.0)
            mean, sd = mean + gain * (observation - mean), np.sqrt(0.25 * (1 - gain))
        new = mean + sd * rng.standard_normal(len(x))
        change = -0.5 * ((new - 0.9 * x) / 0.5) ** 2 + 0.5 * ((new - mean) / sd) ** 2
        return population.moved(new).reweighted(change)


@planted("transition", "variance for standard deviation", exact=exact_ar1)
class VarianceForSd(Transition):
    def predict(self, rng, population, observation):
        return population.moved(rng.normal(0.9 * population.particles, 0.25))


@planted("transition", "positions are cut at two standard deviations of the stationary law", exact=exact_ar1)
class Walls(Transition):
    def predict(self, rng, population, observation):
        return population.moved(np.clip(rng.normal(0.9 * population.particles, 0.5), -2.3, 2.3))


@planted("transition", "one shift of all hypotheses", example=scene_example)
class OneShiftOfScenes(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        shift = rng.integers(-3, 4, size=2)
        moved = [h.with_labels(np.roll(h.labels, shift, (0, 1))) for h in population.particles]
        return population.moved(tuple(moved))


@planted("transition", "objects lose their identity: each gets a new id")
class ForgetsIdentities(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        moved = TrackingTransition().predict(rng, population, observation)
        return moved.moved(tuple(Hypothesis.from_labels(h.labels, h.grid, birth=9) for h in moved.particles))


@dataclass(frozen=True)
class _Backwards(MstRule):
    def candidates(self, rng, track):
        return tuple(replace(c, T=c.T.inv()) for c in super().candidates(rng, track))


@planted("transition", "tracks backwards")
def tracks_backwards():
    return TrackingTransition(rule=_Backwards())


@planted("transition", "hypotheses are shifted by their place in the population", example=scene_example)
class ScenesByPlace(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        moved = [h.with_labels(np.roll(h.labels, k % 3, 0)) for k, h in enumerate(population.particles)]
        return population.moved(tuple(moved))


# --- densities ----------------------------------------------------------------------------------------------------
class _Walk(DensityTransition):
    def predict(self, rng, population, observation):
        return population.moved(0.6 * population.particles + 0.8 * rng.standard_normal(population.particles.shape))


@planted("transition", "the density of the past given the future", exact=lambda rng, n: exact_ar1(rng, n, 0.6, 0.8))
class SwappedDensity(_Walk):
    def log_prob(self, previous, new, observation):
        return Normal(0.6 * new, 0.8).log_prob(previous)


@planted("transition", "the factor 1/2 of the exponent is missing", exact=lambda rng, n: exact_ar1(rng, n, 0.6, 0.8))
class NoHalf(_Walk):
    def log_prob(self, previous, new, observation):
        return -(((new - 0.6 * previous) / 0.8) ** 2)


@planted(
    "transition",
    "the mean over the axes, not the sum",
    example=plane_example,
    exact=lambda rng, n: exact_ar1(rng, n, 0.6, 0.8, 2),
)
class MeanOverAxes(_Walk):
    def log_prob(self, previous, new, observation):
        return (-0.5 * ((new - 0.6 * previous) / 0.8) ** 2 - np.log(0.8)).mean(axis=1)


# --- updates ------------------------------------------------------------------------------------------------------
@planted("update", "the sum over all particles, one number for all")
class OneSumForAll(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(
            np.full(len(population), -0.5 * ((population.particles - observation) ** 2).sum())
        )


@planted("update", "the noise is the spread of the residuals")
class SpreadOfResiduals(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        residual = population.particles - observation
        return population.reweighted(-0.5 * (residual / (residual.std() + 0.1)) ** 2)


@planted("update", "weights by the last observation that it has seen")
@dataclass(frozen=True)
class StaleObservation(Update):
    seen: list = field(default_factory=lambda: [0.0])

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        last, self.seen[0] = self.seen[0], float(np.mean(population.particles))
        return population.reweighted(-0.5 * (population.particles - last) ** 2)


@planted("update", "NaN where the logarithm of a negative number is taken")
class LogOfNegative(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        with np.errstate(invalid="ignore"):
            return population.reweighted(np.log(1 - (population.particles - observation) ** 2 / 4))


@planted("update", "resamples inside the update, and says it is properly weighted", exact=exact_weighted)
class BestHalf(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        out = population.reweighted(Normal(population.particles, 0.5).log_prob(observation))
        best = np.sort(np.argsort(-out.log_weights)[: (len(out) + 1) // 2])
        return out.take(best)


@planted("update", "variance for standard deviation", exact=exact_weighted)
class VarianceOfTheSensor(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(Normal(population.particles, 0.25).log_prob(observation))


@planted("update", "later hypotheses get more weight", example=scene_example)
class LaterIsBetter(Update):
    properly_weighted = False

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(np.array([h.n_objects + 0.2 * k for k, h in enumerate(population.particles)]))


@planted("update", "the log density of every second row is taken twice")
class PeriodOfTwo(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        g = -0.5 * np.square(population.particles - observation).reshape(len(population), -1).sum(axis=1)
        g[1::2] *= 2
        return population.reweighted(g)


# --- proposals ----------------------------------------------------------------------------------------------------
@planted("proposal", "a fixed grid, the generator is never used")
class Grid(Proposal):
    def sample(self, rng, observation, n):
        return Population(observation + np.linspace(-2, 2, n))


@planted("proposal", "half of the draws, each twice", exact=None)
class EachTwice(Proposal):
    def sample(self, rng, observation, n):
        return Population(np.repeat(observation + rng.standard_normal(-(-n // 2)), 2)[:n])


@planted("proposal", "the prior times its own density", exact=exact_prior)
class PriorTwice(Proposal):
    def sample(self, rng, observation, n):
        x = 1.1 * rng.standard_normal(n)
        return Population(x, Normal(0.0, 1.1).log_prob(x))


@planted(
    "proposal",
    "the scale of an exponential is taken as its rate",
    exact=lambda rng, n: (Population(rng.exponential(2.0, n)), 0.4),
)
class RateForScale(Proposal):
    def sample(self, rng, observation, n):
        return Population(rng.exponential(0.5, n))


def _components(frame, grid, heights):
    points = frame.points[frame.valid]
    out = []
    for height in heights:
        voxels = grid.index_of(points[points[:, 2] > height])
        voxels = voxels[grid.contains(voxels)]
        occupied = np.zeros(grid.shape, bool)
        occupied[tuple(voxels.T)] = True
        out.append(ndimage.label(np.maximum.accumulate(occupied[:, :, ::-1], axis=2)[:, :, ::-1])[0])
    return out


@planted("proposal", "takes the first image of the clip")
class OfTheFirstImage(Proposal):
    properly_weighted = False

    def sample(self, rng, observation, n):
        labels = _components(observation.before, observation.grid, rng.uniform(0.01, 0.03, n))
        return Population(tuple(Hypothesis.from_labels(one, observation.grid) for one in labels))


@planted("proposal", "exchanges the axes of the grid")
class AxesExchanged(Proposal):
    properly_weighted = False

    def sample(self, rng, observation, n):
        labels = _components(observation.after, observation.grid, rng.uniform(0.01, 0.03, n))
        return Population(tuple(Hypothesis.from_labels(one.transpose(1, 0, 2), observation.grid) for one in labels))


@planted("proposal", "heights from the global generator")
class GlobalHeights(Proposal):
    properly_weighted = False

    def sample(self, rng, observation, n):
        labels = _components(observation.after, observation.grid, np.random.uniform(0.01, 0.05, n))  # noqa: NPY002
        return Population(tuple(Hypothesis.from_labels(one, observation.grid) for one in labels))


# --- rejuvenations ------------------------------------------------------------------------------------------------
def _log_target(x, previous, observation):
    return -0.5 * ((x - 0.9 * previous) / 0.5) ** 2 - 0.5 * (observation - x) ** 2


class _Moves(Rejuvenation):
    """Moves x (n,) given x_{t-1} and y_t; nothing moves if one of them is missing."""

    def move(self, rng, population, previous, observation):
        if previous is None or observation is None:
            return population
        return population.moved(self.moved(rng, population.particles, previous.particles, observation))


@planted("rejuvenation", "accepts where it should reject", exact=exact_rejuvenated)
class AcceptsTheWorse(_Moves):
    def moved(self, rng, x, previous, y):
        new = x + 0.5 * rng.standard_normal(len(x))
        ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
        return np.where(np.log1p(-rng.random(len(x))) > ratio, new, x)


@planted("rejuvenation", "steps in the logarithm without the Jacobian", exact=exact_rejuvenated)
class NoJacobian(_Moves):
    def moved(self, rng, x, previous, y):
        new = x * np.exp(0.7 * rng.standard_normal(len(x)))
        ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
        return np.where(np.log1p(-rng.random(len(x))) < ratio, new, x)


@planted("rejuvenation", "one uniform number and one step for all particles", exact=exact_rejuvenated)
class OneCoin(_Moves):
    def moved(self, rng, x, previous, y):
        new = x + 0.5 * rng.standard_normal()
        ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
        return np.where(np.log(rng.random()) < ratio, new, x)


@planted("rejuvenation", "the parents in reverse order", exact=exact_rejuvenated)
class ParentsReversed(_Moves):
    def moved(self, rng, x, previous, y):
        new = x + 0.5 * rng.standard_normal(len(x))
        previous = previous[::-1]
        ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
        return np.where(np.log1p(-rng.random(len(x))) < ratio, new, x)


@planted("rejuvenation", "Langevin steps that are never rejected", exact=exact_rejuvenated)
class Unadjusted(_Moves):
    def moved(self, rng, x, previous, y):
        step = 0.2
        slope = -(x - 0.9 * previous) / 0.25 + (y - x)
        return x + 0.5 * step * slope + np.sqrt(step) * rng.standard_normal(len(x))


# --- lookaheads, triggers, sizes ----------------------------------------------------------------------------------
@planted("lookahead", "0/0 if all particles are equal")
class StandardScores(Lookahead):
    def log_priority(self, population, observation):
        distance = np.abs(population.particles - observation)
        with np.errstate(invalid="ignore"):
            return -(distance - distance.mean()) / distance.std()


@planted("lookahead", "noise of the global generator")
class NoisyPriority(Lookahead):
    def log_priority(self, population, observation):
        return -np.abs(population.particles - observation) + np.random.gumbel(size=len(population))  # noqa: NPY002


@planted("lookahead", "a running mean over calls")
@dataclass(frozen=True)
class RunningPriority(Lookahead):
    mean: list = field(default_factory=lambda: [0.0])

    def log_priority(self, population, observation):
        self.mean[0] = 0.5 * self.mean[0] + 0.5 * float(np.mean(population.particles))
        return -np.abs(population.particles - observation - self.mean[0])


@planted("trigger", "counts its calls")
@dataclass(frozen=True)
class EveryThirdCall(Trigger):
    calls: list = field(default_factory=list)

    def wants(self, population, t):
        self.calls.append(t)
        return len(self.calls) % 3 == 0


@planted("trigger", "a coin of the global generator")
class Coin(Trigger):
    def wants(self, population, t):
        return bool(np.random.random() < 0.5)  # noqa: NPY002


@planted("trigger", "one answer for each particle")
class EachParticle(Trigger):
    def wants(self, population, t):
        return population.weights > 0.5


@planted("trigger", "0 log 0 is NaN: with one particle of weight zero it never resamples")
class EntropyOfZero(Trigger):
    def wants(self, population, t):
        w = population.weights
        with np.errstate(all="ignore"):
            return bool(-(w * np.log(w)).sum() < 0.9 * np.log(len(w)))


@planted("size", "counts log weights above -2, whatever their scale")
class AbsoluteLogWeights(Size):
    def choose(self, population):
        return max(1, int((population.log_weights > -2).sum()))


@planted("size", "a float")
class FloatSize(Size):
    def choose(self, population):
        return 2 * population.ess


@planted("size", "counts equal neighbours, not equal particles")
class EqualNeighbours(Size):
    def choose(self, population):
        x = np.floor(np.asarray(population.particles, float).reshape(len(population), -1)[:, 0])
        return 10 * int(1 + (np.diff(x) != 0).sum())


# --- similarities, equivalences, codecs ---------------------------------------------------------------------------
@planted("similarity", "cosine: 0/0 for particles at the origin")
class Cosine(Similarity):
    def matrix(self, particles):
        x = np.asarray(particles, float).reshape(len(particles), -1)
        with np.errstate(invalid="ignore"):
            u = x / np.linalg.norm(x, axis=1, keepdims=True)
        return np.clip(0.5 + 0.5 * u @ u.T, 0, 1)


@planted("similarity", "a nugget: the diagonal is below 1")
class Nugget(Similarity):
    def matrix(self, particles):
        x = np.asarray(particles, float).reshape(len(particles), -1)
        return 0.9 * np.exp(-0.5 * ((x[:, None] - x) ** 2).sum(axis=2))


@planted("similarity", "the root of a rounded negative number on the diagonal")
class RootOfRounding(Similarity):
    def matrix(self, particles):
        x = np.asarray(particles, float).reshape(len(particles), -1)
        square = (x**2).sum(axis=1)
        with np.errstate(invalid="ignore"):
            return np.exp(-np.sqrt(square[:, None] + square - 2 * x @ x.T))


@planted("similarity", "compares label numbers, which have no meaning", example=scene_example)
class LabelNumbers(Similarity):
    def matrix(self, particles):
        labels = np.stack([h.labels.ravel() for h in particles])
        used = labels.max(axis=0) > 0
        return (labels[:, None, used] == labels[None][:, :, used]).mean(axis=2)


@planted("equivalence", "numbers classes by value, not by first occurrence")
class ByValue(Equivalence):
    def classes(self, particles):
        return np.unique(
            np.floor(np.asarray(particles, float).reshape(len(particles), -1)[:, 0]), return_inverse=True
        )[1]


@planted("equivalence", "neighbours on the line that are close are equal, in the order of the array")
class CloseToTheOneBefore(Equivalence):
    def classes(self, particles):
        x = np.asarray(particles, float).reshape(len(particles), -1)[:, 0]
        return np.append(0, np.cumsum(np.abs(np.diff(x)) > 0.5))


@planted("codec", "words are cut after four letters", example=words_example)
class ShortWords(Codec):
    def encode(self, particles):
        return {"words": np.array(particles, dtype="U4")}

    def decode(self, arrays):
        return tuple(arrays["words"].tolist())


@planted("codec", "the shape is lost", example=plane_example)
class Flat(Codec):
    def encode(self, particles):
        return {"x": np.ravel(particles)}

    def decode(self, arrays):
        return arrays["x"]


@planted("codec", "a single particle loses its axis")
class Squeezed(Codec):
    def encode(self, particles):
        return {"x": np.squeeze(particles)}

    def decode(self, arrays):
        return arrays["x"]


# --- parts of MST -------------------------------------------------------------------------------------------------
@planted("completer", "keeps the first result of each size of box")
@dataclass(frozen=True)
class BySize(Completer):
    kept: dict = field(default_factory=dict)

    def fill(self, rng, seen):
        return self.kept.setdefault(seen.surface.shape, Extrude().fill(rng, seen))


@planted("completer", "several boxes are divided by the largest probability of all")
class DividedByAll(Completer):
    def fill(self, rng, seen):
        return 0.9 * Extrude().fill(rng, seen)

    def fill_many(self, rngs, seen):
        filled = [self.fill(rng, one) for rng, one in zip(rngs, seen, strict=True)]
        total = sum(p.size for p in filled)
        return [np.clip(p * (1 - 0.1 * p.size / total), 0, 1) for p in filled]


@planted("completer", "extrudes along the first axis of the grid")
class Sideways(Completer):
    def fill(self, rng, seen):
        filled = np.maximum.accumulate(seen.surface, axis=0) | np.maximum.accumulate(seen.surface[::-1], axis=0)[::-1]
        return np.where(filled, 0.9, 0.0)


def _rule(change=lambda T: T, choose=min):
    """A rule of the candidates of `MstRule` with changed motions."""

    @dataclass(frozen=True)
    class Rule(MstRule):
        def candidates(self, rng, track):
            return tuple(replace(c, T=change(c.T, track)) for c in super().candidates(rng, track))

        def choose(self, rng, candidates):
            return choose(candidates, key=lambda c: c.score)

    return Rule()


planted("rule", "moves objects backwards")(lambda: _rule(lambda T, track: T.inv()))
planted("rule", "chooses the candidate of the worst score")(lambda: _rule(lambda T, track: T, max))
planted("rule", "the motion is given in the frame of the camera")(
    lambda: _rule(lambda T, track: track.clip.after.camera.pose.inv() * T * track.clip.after.camera.pose)
)
planted("rule", "the rotation is about the object, the translation still about the origin")(
    lambda: _rule(
        lambda T, track: RigidTransform.from_translation(track.points.mean(axis=0)) * T if T.translation.any() else T
    )
)
planted("rule", "goes half of the way")(
    lambda: _rule(lambda T, track: RigidTransform.from_components(0.5 * T.translation, T.rotation))
)
planted("rule", "exchanges x and y")(
    lambda: _rule(lambda T, track: RigidTransform.from_components(T.translation[[1, 0, 2]], T.rotation))
)
planted("rule", "metres taken for millimetres")(
    lambda: _rule(lambda T, track: RigidTransform.from_components(T.translation / 1000, T.rotation))
)


@planted("registration", "exchanges source and target")
class FromTargetToSource(Registration):
    def register(self, source, target, init, reach):
        found = SmallGicp().register(source, target, init, reach)
        return None if found is None else replace(found, T=np.linalg.inv(found.T))


@planted("tracker", "follows masks against the flow")
class AgainstTheFlow(MaskTracker):
    def track(self, clip, masks):
        from mstfilter.mst.tracking import DenseFlow

        tracks = DenseFlow().track(clip)
        out = []
        for mask in masks:
            moved = tracks.warp(mask.astype(np.uint8)) > 0
            shift = np.subtract(_middle(mask), _middle(moved)) if mask.any() and moved.any() else np.zeros(2)
            out.append(ndimage.shift(mask.astype(float), shift, order=0) > 0.5)
        return out


def _middle(mask):
    return np.argwhere(mask).mean(axis=0)


@planted("boundary", "strong where nothing is")
class Inverted(BoundaryModel):
    def boundary(self, frame):
        return 1 - ColourDepthBoundary().boundary(frame)


@planted("free_space", "clears what is hidden instead of what is seen to be free")
class ClearsHidden(FreeSpace):
    def project(self, hypothesis, frame):
        from mstfilter.scene import frame_geometry

        hidden = ~frame_geometry(frame, hypothesis.grid).known_free(0.01)
        labels = hypothesis.labels.copy()
        labels[hidden] = 0
        n = max(1, int((hypothesis.labels > 0).sum()))
        return hypothesis.with_labels(labels), float((labels > 0).sum() / n)


@planted("rule", "a candidate of its own random numbers")
class RuleOfItsOwn(MstRule):
    def choose(self, rng, candidates):
        return candidates[int(np.random.default_rng().integers(len(candidates)))]
