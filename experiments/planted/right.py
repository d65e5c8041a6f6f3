"""Right components in the styles in which users write them. `RIGHT` has the same form as `faults.FAULTS`."""

from __future__ import annotations

import bisect
import math
import random
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from entries import (
    Entries,
    exact_ar1,
    exact_moved,
    exact_prior,
    exact_rejuvenated,
    exact_weighted,
    integer_example,
    mapping_example,
    object_example,
    plane_example,
    scene_example,
    words_example,
)
from scipy import ndimage, special, stats
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.completion import Completer
from mstfilter.mst.segmentation import BoundaryModel
from mstfilter.mst.tracking import IDENTITY, Candidate, MotionResidual, MotionRule, MstRule, TrackingTransition
from mstfilter.scene import Evidence, Hypothesis
from mstfilter.smc import (
    Bins,
    Codec,
    DensityTransition,
    Equivalence,
    EssBelow,
    Kld,
    Lookahead,
    MultivariateNormal,
    Normal,
    Population,
    Proposal,
    Rejuvenation,
    Resampler,
    Similarity,
    Size,
    Systematic,
    Transition,
    Trigger,
    Update,
    WeightResampler,
    child,
    log_mean_exp,
    normalise,
    union,
)

RIGHT = Entries()
right = RIGHT.add


# --- resamplers ---------------------------------------------------------------------------------------------------
def alias_table(weights):
    """Vose's alias method: the probability of each column, and its alias."""
    m = len(weights)
    share, alias = m * weights / weights.sum(), np.arange(m)
    small, large = [i for i in range(m) if share[i] < 1], [i for i in range(m) if share[i] >= 1]
    while small and large:
        s, big = small.pop(), large.pop()
        alias[s] = big
        share[big] -= 1 - share[s]
        (small if share[big] < 1 else large).append(big)
    for i in small + large:
        share[i] = 1.0
    return share, alias


@right("resampler", "the alias method")
class Alias(WeightResampler):
    def select(self, rng, log_weights, n):
        share, alias = alias_table(normalise(log_weights))
        column = rng.integers(len(share), size=n)
        return np.where(rng.random(n) < share[column], column, alias[column]), None


@right("resampler", "the alias method with one uniform number for column and coin")
class AliasFraction(WeightResampler):
    def select(self, rng, log_weights, n):
        share, alias = alias_table(normalise(log_weights))
        u = rng.random(n) * len(share)
        column = np.minimum(u.astype(int), len(share) - 1)
        return np.where(u - column < share[column], column, alias[column]), None


@right("resampler", "a Python loop with bisect, parameters with other names")
class Bisect(WeightResampler):
    def select(self, generator, logw, size):
        cumulative = list(np.cumsum(np.exp(logw - max(logw))))
        last = max(i for i, w in enumerate(logw) if w > -math.inf)
        return [
            min(bisect.bisect_right(cumulative, generator.random() * cumulative[-1]), last) for _ in range(size)
        ], None


@right("resampler", "a Python loop for systematic draws")
class WheelLoop(WeightResampler):
    def select(self, g, lw, m):
        w = normalise(lw).tolist()
        u, i, c, out = g.random() / m, 0, w[0], []
        for k in range(m):
            while u + k / m >= c and i < len(w) - 1 and any(v > 0 for v in w[i + 1 :]):
                i += 1
                c += w[i]
            out.append(i)
        return np.array(out), None


@right("resampler", "rng.choice")
class Choice(WeightResampler):
    def select(self, rng, log_weights, n):
        return rng.choice(len(log_weights), size=n, p=normalise(log_weights)), None


@right("resampler", "rng.multinomial, in the order of the particles")
class Counts(WeightResampler):
    def select(self, rng, log_weights, n):
        return np.repeat(np.arange(len(log_weights)), rng.multinomial(n, normalise(log_weights))), None


@right("resampler", "sorted uniform numbers from exponential spacings")
class Spacings(WeightResampler):
    def select(self, rng, log_weights, n):
        points = np.cumsum(rng.standard_exponential(n + 1))
        cumulative = np.cumsum(normalise(log_weights))
        return np.searchsorted(cumulative, points[:-1] / points[-1] * cumulative[-1], side="right"), None


@right("resampler", "the Gumbel trick")
class Gumbel(WeightResampler):
    def select(self, rng, log_weights, n):
        out = [int(np.argmax(log_weights + rng.gumbel(size=len(log_weights)))) for _ in range(n)]
        return np.array(out), None


@right("resampler", "systematic around a circle")
class Circle(WeightResampler):
    def select(self, rng, log_weights, n):
        points = np.sort((np.arange(n) / n + rng.random()) % 1.0)
        cumulative = np.cumsum(normalise(log_weights))
        return np.searchsorted(cumulative, points * cumulative[-1], side="right"), None


@right("resampler", "systematic over the particles in descending order of weight")
class Descending(WeightResampler):
    def select(self, rng, log_weights, n):
        order = np.argsort(-log_weights, kind="stable")
        cumulative = np.cumsum(normalise(log_weights)[order])
        points = (np.arange(n) + rng.random()) / n
        return order[np.searchsorted(cumulative, points * cumulative[-1], side="right")], None


@right("resampler", "systematic over shuffled particles")
class ShuffledWheel(WeightResampler):
    def select(self, rng, log_weights, n):
        order = rng.permutation(len(log_weights))
        cumulative = np.cumsum(normalise(log_weights)[order])
        points = (np.arange(n) + rng.random()) / n
        return order[np.searchsorted(cumulative, points * cumulative[-1], side="right")], None


def _residual(rng, log_weights, n, drawn):
    expected = n * normalise(log_weights)
    copies = np.floor(expected * (1 + 1e-14)).astype(np.int64)
    rest = n - int(copies.sum())
    if rest > 0:
        copies = copies + np.bincount(drawn(rng, np.maximum(expected - copies, 0), rest), minlength=len(copies))
    return np.repeat(np.arange(len(copies)), copies), None


def _inverse(points, weights):
    cumulative = np.cumsum(weights)
    return np.searchsorted(cumulative, points * cumulative[-1], side="right")


@right("resampler", "residual with a stratified rest")
class ResidualStratified(WeightResampler):
    def select(self, rng, log_weights, n):
        return _residual(rng, log_weights, n, lambda g, w, k: _inverse((np.arange(k) + g.random(k)) / k, w))


@right("resampler", "residual with a systematic rest")
class ResidualSystematic(WeightResampler):
    def select(self, rng, log_weights, n):
        return _residual(rng, log_weights, n, lambda g, w, k: _inverse((np.arange(k) + g.random()) / k, w))


@right("resampler", "residual with a multinomial rest, positions shuffled")
class ResidualShuffled(WeightResampler):
    def select(self, rng, log_weights, n):
        found, _ = _residual(rng, log_weights, n, lambda g, w, k: _inverse(g.random(k), w))
        return rng.permutation(found), None


@right("resampler", "antithetic uniform numbers")
class Antithetic(WeightResampler):
    def select(self, rng, log_weights, n):
        u = rng.random(-(-n // 2))
        points = np.concatenate([u, 1 - u])[:n]
        return _inverse(points * (1 - 1e-15), normalise(log_weights)), None


@right("resampler", "rejection by the largest weight")
class Rejection(WeightResampler):
    def select(self, rng, log_weights, n):
        w = np.exp(log_weights - log_weights.max())
        out = rng.integers(len(w), size=n)
        todo = np.flatnonzero(rng.random(n) >= w[out])
        while len(todo):
            out[todo] = rng.integers(len(w), size=len(todo))
            todo = todo[rng.random(len(todo)) >= w[out[todo]]]
        return out, None


@right("resampler", "a Metropolis chain that is long enough")
class LongChain(WeightResampler):
    def select(self, rng, log_weights, n):
        w = np.exp(log_weights - log_weights.max())
        at = np.full(n, int(np.argmax(w)))
        for _ in range(int(12 / w.mean()) + 1):
            new = rng.integers(len(w), size=n)
            at = np.where(rng.random(n) * w[at] < w[new], new, at)
        return at, None


@right("resampler", "a generator of the standard library, seeded by the given one")
class StandardLibrary(WeightResampler):
    def select(self, rng, log_weights, n):
        own = random.Random(int(rng.integers(2**62)))
        return np.array(own.choices(range(len(log_weights)), normalise(log_weights).tolist(), k=n)), None


@right("resampler", "a legacy generator, seeded by the given one")
class Legacy(WeightResampler):
    def select(self, rng, log_weights, n):
        own = np.random.RandomState(rng.integers(2**31))
        return own.choice(len(log_weights), n, p=normalise(log_weights)), None


@right("resampler", "particles survive by their weight relative to the largest, the others are drawn")
class Survival(WeightResampler):
    def select(self, rng, log_weights, n):
        w = np.exp(log_weights - log_weights.max())
        drawn = _inverse(rng.random(n), w)
        return np.where(rng.random(n) < w, np.arange(n), drawn) if n == len(w) else drawn, None


@right("resampler", "draws by the square root of the weights, with what corrects for it")
class SquareRoot(WeightResampler):
    def select(self, rng, log_weights, n):
        half = 0.5 * log_weights
        out = _inverse((np.arange(n) + rng.random()) / n, normalise(half))
        return out, log_weights[out] - half[out] + log_mean_exp(half)


@right("resampler", "Fearnhead and Clifford's optimal scheme, written from the paper")
class Optimal(WeightResampler):
    exact_size: ClassVar[bool] = False

    def select(self, rng, log_weights, n):
        w = np.exp(log_weights - log_weights.max())
        positive = np.flatnonzero(w > 0)
        m = len(w)
        if len(positive) <= n:
            return positive, log_weights[positive] + math.log(len(positive) / m)
        v = np.sort(w[positive])
        for k in range(len(v)):  # k particles are below the threshold
            c = np.cumsum(v)[len(v) - 1 - k] / (n - k) if k < n else np.inf
            if k == n or v[len(v) - 1 - k] <= c:
                break
        keep = positive[w[positive] > c]
        light = np.where((w > 0) & (w <= c), w, 0.0)
        chosen = _inverse((np.arange(n - len(keep)) + rng.random()) / max(n - len(keep), 1), light)
        out = np.concatenate([keep, chosen])
        new = np.concatenate([w[keep], np.full(len(chosen), c)])
        return out, np.log(new) + log_weights.max() + math.log(len(out) / m)


@right("resampler", "two stages: a group of eight, then a member")
class TwoStages(WeightResampler):
    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        groups = np.arange(len(weights)) // 8
        mass = np.bincount(groups, weights)
        out = []
        for g in _inverse(rng.random(n), mass):
            members = np.flatnonzero(groups == g)
            out.append(members[_inverse(rng.random(1), weights[members])[0]])
        return np.array(out), None


@right("resampler", "SSP, particle by particle")
class SspLoop(WeightResampler):
    def select(self, rng, log_weights, n):
        p = n * normalise(log_weights)
        copies = np.floor(p).astype(int)
        p = p - copies
        i, j = 0, 1
        while j < len(p):
            up, down = min(p[j], 1 - p[i]), min(p[i], 1 - p[j])
            if up + down <= 0:
                i = j if p[i] <= 0 or p[i] >= 1 else i
                j += 1
                continue
            if rng.random() * (up + down) < down:
                p[i], p[j] = p[i] + up, p[j] - up
            else:
                p[i], p[j] = p[i] - down, p[j] + down
            copies[i] += p[i] > 1 - 1e-9
            copies[j] += p[j] > 1 - 1e-9
            p[[i, j]] = np.where(p[[i, j]] > 1 - 1e-9, 0, p[[i, j]])
            if p[i] < 1e-9:
                i = j
            j += 1
        short = n - copies.sum()
        if short > 0:
            copies[i] += short
        return np.repeat(np.arange(len(p)), copies), None


@right("resampler", "sorts particles by value, then systematic; a class with __init__ and no dataclass")
class ByPosition(Resampler):
    def __init__(self, axis=0):
        self.axis = axis

    def resample(self, g, pop, size):
        x = np.asarray(pop.particles, float).reshape(len(pop), -1)[:, self.axis]
        order = np.argsort(x, kind="stable")
        out = order[_inverse((np.arange(size) + g.random()) / size, pop.weights[order])]
        return pop.select(out, np.full(size, pop.log_mean_weight), largest=float(pop.weights.max()))


@right("resampler", "a scheme that wraps another, with unsigned indices")
class Wraps(WeightResampler):
    def select(self, rng, log_weights, n):
        out, lw = Systematic().select(rng, log_weights, n)
        return out.astype(np.uint32), lw


@right("resampler", "a lattice with a random shift")
class Lattice(WeightResampler):
    def select(self, rng, log_weights, n):
        points = (np.arange(n) * 0.6180339887498949 + rng.random()) % 1.0
        return _inverse(points, normalise(log_weights)), None


@right("resampler", "the best n, which says that it is not properly weighted")
class Greedy(WeightResampler):
    properly_weighted = False

    def select(self, rng, log_weights, n):
        order = np.argsort(-log_weights, kind="stable")[: (log_weights > -np.inf).sum()]
        return np.resize(order, n), None


# --- transitions --------------------------------------------------------------------------------------------------
@right("transition", "a Python loop, parameters with other names", exact=exact_ar1)
class LoopWalk(Transition):
    def predict(self, gen, pop, y):
        return Population(np.array([gen.normal(0.9 * x, 0.5) for x in pop.particles]), pop.log_weights, pop.parents)


@right("transition", "particles are a mapping", example=mapping_example)
class Newton(Transition):
    def predict(self, rng, population, observation):
        x, v = population.particles["x"], population.particles["v"]
        v = v + 0.1 * rng.standard_normal(len(v))
        return population.moved({"x": x + v[:, None] * [1.0, 0.0], "v": v})


@right("transition", "particles are integers", example=integer_example)
class Markov(Transition):
    def predict(self, rng, population, observation):
        return population.moved((population.particles + rng.choice([-1, 0, 1], len(population))) % 5)


@right("transition", "particles are tuples", example=object_example)
class Tuples(Transition):
    def predict(self, rng, population, observation):
        return population.moved([(0.5 * a + rng.normal(), b) for a, b in population.particles])


@right("transition", "nothing is random")
class Drift(Transition):
    def predict(self, rng, population, observation):
        return population.moved(0.9 * population.particles + 0.1)


@right("transition", "nothing moves, and the result is a view")
class Stays(Transition):
    draws = False

    def predict(self, rng, population, observation):
        return population.moved(population.particles[:])


@right("transition", "single precision")
class SingleWalk(Transition):
    def predict(self, rng, population, observation):
        x = population.particles.astype(np.float32)
        return population.moved(x + rng.standard_normal(x.shape, dtype=np.float32))


@right("transition", "correlated noise of two axes", example=plane_example)
class Correlated(Transition):
    def predict(self, rng, population, observation):
        L = np.array([[1.0, 0.0], [0.9, 0.43]])
        return population.moved(population.particles + rng.standard_normal((len(population), 2)) @ L.T)


@right("transition", "a stream for each particle")
class Streams(Transition):
    def predict(self, rng, population, observation):
        noise = [child(rng, "noise", k).standard_normal() for k in range(len(population))]
        return population.moved(
            population.particles + np.reshape(noise, (-1, *[1] * (population.particles.ndim - 1)))
        )


@right("transition", "heavy tails, rare jumps, noise that grows with |x|")
class Jumps(Transition):
    def predict(self, rng, population, observation):
        x = population.particles
        jump = rng.random(x.shape) < 0.05
        return population.moved(x + (0.1 + 0.3 * np.abs(x)) * rng.standard_t(4, x.shape) + np.where(jump, 5.0, 0.0))


@right("transition", "a guided move with all constants", exact=exact_moved)
class GuidedMove(Transition):
    def predict(self, rng, population, y):
        x = population.particles
        if y is None:
            return population.moved(rng.normal(0.9 * x, 0.5))
        q = Normal(0.9 * x + 0.2 * (y - 0.9 * x), math.sqrt(0.2))
        new = q.sample(rng, len(x))
        return population.moved(new).reweighted(Normal(0.9 * x, 0.5).log_prob(new) - q.log_prob(new))


@right("transition", "three successors of each particle")
class Successors(Transition):
    def predict(self, rng, population, observation):
        index = np.repeat(np.arange(len(population)), 3)
        moved = population.particles[index] + rng.standard_normal((len(index), *population.particles.shape[1:]))
        return Population(moved, population.log_weights[index], {"previous": index})


@right("transition", "forgets: says that it is not properly weighted")
class Forgets(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        x = population.particles
        return Population(x + rng.standard_normal(x.shape), 0.5 * population.log_weights, population.parents)


@right("transition", "shrinks to the weighted mean, says that it is not properly weighted")
class LiuWest(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        x = population.particles
        mean = np.tensordot(population.weights, x, axes=1)
        return population.moved(mean + 0.98 * (x - mean) + 0.2 * x.std() * rng.standard_normal(x.shape))


@right(
    "transition", "a density in the plane", example=plane_example, exact=lambda rng, n: exact_ar1(rng, n, 0.6, 0.8, 2)
)
class PlaneDensity(DensityTransition):
    def predict(self, rng, population, observation):
        return population.moved(rng.normal(0.6 * population.particles, 0.8))

    def log_prob(self, past, future, observation):
        return stats.norm.logpdf(future, 0.6 * past, 0.8).sum(axis=1)


@right("transition", "a density of mixed noise")
class MixtureDensity(DensityTransition):
    def predict(self, rng, population, observation):
        x = population.particles
        wide = rng.random(len(x)) < 0.3
        return population.moved(x + np.where(wide, 2.0, 0.3) * rng.standard_normal(len(x)))

    def log_prob(self, previous, new, observation):
        parts = [np.log(p) + Normal(previous, s).log_prob(new) for p, s in ((0.3, 2.0), (0.7, 0.3))]
        return np.logaddexp(*parts)


@right("transition", "a density of bounded support")
class UniformDensity(DensityTransition):
    def predict(self, rng, population, observation):
        return population.moved(population.particles + rng.uniform(-1, 2, population.particles.shape))

    def log_prob(self, previous, new, observation):
        inside = (new - previous >= -1) & (new - previous <= 2)
        return np.where(inside, -np.log(3.0), -np.inf)


@right("transition", "tracks scenes and shifts objects, each by its own draw")
class ShiftsScenes(Transition):
    properly_weighted = False

    def predict(self, rng, population, observation):
        out = []
        for h in population.particles:
            shift = rng.integers(-1, 2, size=2)
            out.append(h.with_labels(np.roll(h.labels, shift, (0, 1))))
        return population.moved(tuple(out))


@right("transition", "the tracking of the package with a rule of its own")
def own_tracking():
    return TrackingTransition(rule=MstRule(use_sift=False, n_refine=1))


# --- updates ------------------------------------------------------------------------------------------------------
@right("update", "scipy and a loop", exact=exact_weighted)
class LoopUpdate(Update):
    def update(self, g, pred, prop, y):
        pop = union(pred, prop)
        return pop.reweighted([stats.norm(x, 0.5).logpdf(y) for x in pop.particles])


@right("update", "bounded support: some weights are 0")
class Window(Update):
    draws = False

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        inside = np.abs(population.particles - observation) < 5
        return population.reweighted(np.where(inside, 0.0, -np.inf))


@right("update", "heavy tails and a mapping", example=mapping_example)
class MappingUpdate(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(stats.t(3).logpdf(population.particles["x"][:, 0] - observation))


@right("update", "an unbiased random likelihood")
class PseudoMarginal(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        noise = rng.standard_normal((len(population), 8))
        return population.reweighted(log_rows(-0.5 * (population.particles[:, None] + noise - observation) ** 2))


def log_rows(a):
    return special.logsumexp(a, axis=1) - np.log(a.shape[1])


@right("update", "a count", example=integer_example)
class CountUpdate(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(stats.poisson.logpmf(observation, 0.5 + population.particles))


@right("update", "ranks of scores, says that it is not properly weighted")
class Ranked(Update):
    properly_weighted = False

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        score = -np.abs(population.particles - observation)
        return population.reweighted(stats.rankdata(score))


@right("update", "moves the particles to the observation, with the weights of it")
class KalmanLike(Update):
    properly_weighted = False

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.moved(0.5 * (population.particles + observation)).reweighted(
            -0.5 * (population.particles - observation) ** 2
        )


@right("update", "scenes: the number of objects, never random", example=scene_example)
class SceneUpdate(Update):
    properly_weighted = False

    def update(self, rng, predicted, proposed, clip):
        population = union(predicted, proposed)
        return population.reweighted(np.array([-0.5 * abs(h.n_objects - 3) for h in population.particles]))


@right("update", "a correlated Gaussian likelihood of vectors", example=plane_example)
class VectorUpdate(Update):
    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        g = MultivariateNormal(population.particles, [[0.5, 0.2], [0.2, 0.4]])
        return population.reweighted(g.log_prob(observation))


# --- proposals ----------------------------------------------------------------------------------------------------
@right("proposal", "stratified: the k-th particle comes from the k-th stratum", exact=exact_prior)
class Strata(Proposal):
    def sample(self, rng, observation, n):
        return Population(stats.norm.ppf((np.arange(n) + rng.random(n)) / n))


@right("proposal", "weighted draws of another distribution, parameters with other names", exact=exact_prior)
class WeighedPrior(Proposal):
    def sample(self, g, y, number):
        q = stats.t(5)
        x = q.rvs(number, random_state=g)
        return Population(x, stats.norm.logpdf(x) - q.logpdf(x))


@right("proposal", "one known point")
class KnownStart(Proposal):
    def sample(self, rng, observation, n):
        return Population(np.zeros(n))


@right("proposal", "two clusters, in a loop")
class Clusters(Proposal):
    def sample(self, rng, observation, n):
        return Population([float(rng.normal(-2 if rng.random() < 0.3 else 1, 0.5)) for _ in range(n)])


@right("proposal", "a mapping, drawn on [0, 1)")
class MappingPrior(Proposal):
    def sample(self, rng, observation, n):
        return Population({"x": rng.random((n, 2)), "on": rng.random(n) < 0.5})


@right("proposal", "scenes of random heights")
class Heights(Proposal):
    properly_weighted = False

    def sample(self, rng, clip, n):
        frame, grid, out = clip.after, clip.grid, []
        points = frame.points[frame.valid]
        for height in rng.uniform(0.01, 0.05, n):
            index = grid.index_of(points[points[:, 2] > height])
            occupied = np.zeros(grid.shape, bool)
            occupied[tuple(index[grid.contains(index)].T)] = True
            filled = np.maximum.accumulate(occupied[:, :, ::-1], axis=2)[:, :, ::-1]
            labels = ndimage.label(filled)[0]
            out.append(Hypothesis.from_labels(labels, grid, birth=clip.index))
        return Population(tuple(out))


@right("proposal", "scenes: one blob, the same for all particles")
class Blob(Proposal):
    properly_weighted = False

    def sample(self, rng, clip, n):
        frame, grid = clip.after, clip.grid
        with np.errstate(invalid="ignore"):
            index = grid.index_of(frame.points[frame.valid & (frame.points[..., 2] > 0.01)])
        labels = np.zeros(grid.shape, np.uint16)
        labels[tuple(index[grid.contains(index)].T)] = 1
        return Population((Hypothesis.from_labels(labels, grid, birth=clip.index),) * n)


# --- rejuvenations ------------------------------------------------------------------------------------------------
def _log_target(x, previous, observation):
    return -0.5 * ((x - 0.9 * previous) / 0.5) ** 2 - 0.5 * (observation - x) ** 2


class _Moves(Rejuvenation):
    def move(self, g, pop, past, y):
        if past is None or y is None:
            return pop
        return pop.moved(self.moved(g, pop.particles, past.particles, y))


@right("rejuvenation", "five Metropolis sweeps in a loop", exact=exact_rejuvenated)
class Sweeps(_Moves):
    def moved(self, rng, x, previous, y):
        for _ in range(5):
            new = x + 0.5 * rng.standard_normal(len(x))
            ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
            x = np.where(-rng.standard_exponential(len(x)) < ratio, new, x)
        return x


@right("rejuvenation", "a Gibbs draw", exact=exact_rejuvenated)
class GibbsDraw(_Moves):
    def moved(self, rng, x, previous, y):
        return rng.normal(0.9 * previous + 0.2 * (y - 0.9 * previous), math.sqrt(0.2))


@right("rejuvenation", "MALA", exact=exact_rejuvenated)
class Mala(_Moves):
    def moved(self, rng, x, previous, y):
        step = 0.2

        def drift(v):
            return v + 0.5 * step * (-(v - 0.9 * previous) / 0.25 + (y - v))

        new = drift(x) + math.sqrt(step) * rng.standard_normal(len(x))
        ratio = _log_target(new, previous, y) - _log_target(x, previous, y)
        ratio += (-((x - drift(new)) ** 2) + (new - drift(x)) ** 2) / (2 * step)
        return np.where(np.log1p(-rng.random(len(x))) < ratio, new, x)


@right("rejuvenation", "does nothing", exact=exact_rejuvenated)
class DoesNothing(Rejuvenation):
    draws = False

    def move(self, rng, population, previous, observation):
        return population


# --- lookaheads, triggers, sizes ----------------------------------------------------------------------------------
@right("lookahead", "a likelihood at the predicted mean")
class AtTheMean(Lookahead):
    def log_priority(self, pop, y):
        return -0.5 * (0.9 * np.asarray(pop.particles) - y) ** 2 / 1.25


@right("lookahead", "bounded from below, relative to the best")
class BoundedPriority(Lookahead):
    def log_priority(self, population, observation):
        priority = -np.abs(population.particles - observation)
        return np.maximum(priority, priority.max() - 5)


@right("lookahead", "a list of floats")
class ListPriority(Lookahead):
    def log_priority(self, population, observation):
        return np.array([-abs(float(x) - observation) for x in population.particles])


@right("trigger", "entropy, with 0 log 0 = 0")
class Entropy(Trigger):
    def wants(self, pop, step):
        return bool(special.entr(pop.weights).sum() < 0.8 * np.log(len(pop)))


@right("trigger", "numpy's bool")
class NumpyBool(Trigger):
    def wants(self, population, t):
        return population.weights.max() > 0.3


@right("trigger", "at even times, or if the effective number is small")
class EvenOrSmall(Trigger):
    def wants(self, population, t):
        return t % 2 == 0 or EssBelow(0.2).wants(population, t)


@right("trigger", "the first ten steps only")
@dataclass(frozen=True)
class FirstSteps(Trigger):
    last: int = 10

    def wants(self, population, t):
        return t < self.last


@right("size", "KLD with a bound of its own")
class OwnKld(Size):
    def choose(self, population):
        x = np.floor(np.asarray(population.particles, float).reshape(len(population), -1))
        k = len({tuple(row) for row, w in zip(x, population.weights, strict=True) if w > 0})
        if k < 2:
            return 10
        z = 2.326
        a = 2 / (9 * (k - 1))
        return int(min(5000, max(10, math.ceil((k - 1) / 0.1 * (1 - a + math.sqrt(a) * z) ** 3))))


@right("size", "numpy's integer")
class NumpySize(Size):
    def choose(self, population):
        return np.int64(np.clip(np.round(2 * population.ess, 6), 5, 500))


@right("size", "the package's KLD with other bins")
def wide_kld():
    return Kld(equivalence=Bins(2.0), epsilon=0.2)


@right("size", "as many as there are")
class AsMany(Size):
    def choose(self, population):
        return len(population)


# --- similarities, equivalences, codecs ---------------------------------------------------------------------------
@right("similarity", "a loop with a cut at a distance")
class Near(Similarity):
    def matrix(self, particles):
        n = len(particles)
        out = np.zeros((n, n))
        for i in range(n):
            for j in range(n):
                out[i, j] = max(0.0, 1 - float(np.abs(np.subtract(particles[i], particles[j])).max()))
        return out


@right("similarity", "equal or not, as bool")
class Same(Similarity):
    def matrix(self, particles):
        x = np.asarray(particles).reshape(len(particles), -1)
        return (x[:, None] == x).all(axis=2)


@right("similarity", "scenes by the number of objects, single precision", example=scene_example)
class CountSimilarity(Similarity):
    def matrix(self, particles):
        k = np.array([h.n_objects for h in particles], np.float32)
        return 1 / (1 + np.abs(k[:, None] - k))


@right("similarity", "Jaccard index of the occupied voxels", example=scene_example)
class Occupied(Similarity):
    def matrix(self, particles):
        o = np.stack([h.labels.ravel() > 0 for h in particles]).astype(float)
        both = o @ o.T
        size = np.diag(both)
        return np.where(np.eye(len(o)) > 0, 1.0, both / np.maximum(size[:, None] + size - both, 1))


@right("equivalence", "a dictionary of rounded rows")
class Rounded(Equivalence):
    def classes(self, particles):
        seen = {}
        rows = np.round(np.asarray(particles, float).reshape(len(particles), -1))
        return np.array([seen.setdefault(tuple(r.tolist()), len(seen)) for r in rows])


@right("equivalence", "all are equal")
class AllEqual(Equivalence):
    def classes(self, particles):
        return np.zeros(len(particles), int)


@right("equivalence", "tuples by their integer", example=object_example)
class ByInteger(Equivalence):
    def classes(self, particles):
        order = list(dict.fromkeys(b for _, b in particles))
        return [order.index(b) for _, b in particles]


@right("equivalence", "scenes by the volumes of their objects", example=scene_example)
class ByVolumes(Equivalence):
    def classes(self, particles):
        names = [tuple(sorted(h.volumes().values())) for h in particles]
        first = {name: k for k, name in enumerate(dict.fromkeys(names))}
        return np.array([first[name] for name in names])


@right("codec", "text as bytes", example=words_example)
class Bytes(Codec):
    def encode(self, particles):
        text = "\n".join(particles).encode()
        return {"text": np.frombuffer(text, np.uint8)}

    def decode(self, arrays):
        return tuple(arrays["text"].tobytes().decode().split("\n"))


@right("codec", "columns of tuples", example=object_example)
class Columns(Codec):
    def encode(self, particles):
        a, b = zip(*particles, strict=True)
        return {"a": np.array(a), "b": np.array(b, np.int64)}

    def decode(self, arrays):
        return tuple(zip(arrays["a"].tolist(), arrays["b"].tolist(), strict=True))


@right("codec", "a mapping of arrays as it is", example=mapping_example)
class AsItIs(Codec):
    def encode(self, particles):
        return dict(particles)

    def decode(self, arrays):
        return dict(arrays)


# --- parts of MST -------------------------------------------------------------------------------------------------
@right("evidence", "voxels, in thousands")
class Volume(Evidence):
    def log_score(self, hypotheses, clip):
        return np.array([-(h.labels > 0).sum() / 1000 for h in hypotheses])


@right("evidence", "the spread of volumes, in a list of Python floats")
class EvenVolumes(Evidence):
    def log_score(self, hypotheses, clip):
        return np.array([-float(np.std([*h.volumes().values(), 0.0])) / 100 for h in hypotheses])


@right("rule", "always at rest")
class Rest(MotionRule):
    def candidates(self, rng, track):
        return (IDENTITY,)

    def choose(self, rng, candidates):
        return candidates[0]


@right("rule", "the median of the flow")
class MedianFlow(MotionRule):
    def candidates(self, rng, track):
        p, q = track.flow_pairs
        if len(p) < 5:
            return (IDENTITY,)
        return IDENTITY, Candidate("flow", RigidTransform.from_translation(np.median(q - p, axis=0)), len(p), -1.0)

    def choose(self, rng, found):
        return found[-1]


@right("rule", "draws rest or the flow by their residuals")
@dataclass(frozen=True)
class DrawsMotion(MotionRule):
    residual: MotionResidual = field(default_factory=MotionResidual)

    def candidates(self, rng, track):
        rest = replace(IDENTITY, score=self.residual.score(track, np.eye(4)))
        p, q = track.flow_pairs
        if len(p) < 5:
            return (rest,)
        shift = RigidTransform.from_translation((q - p).mean(axis=0))
        return rest, Candidate("flow", shift, len(p), self.residual.score(track, shift.as_matrix()))

    def choose(self, rng, candidates):
        s = np.array([c.score for c in candidates])
        s = np.where(np.isfinite(s), s, 1e9)
        w = np.exp(-(s - s.min()))
        return candidates[rng.choice(len(s), p=w / w.sum())]


@right("rule", "the package's rule, sampled")
def sampled_rule():
    return MstRule(select="sample", use_sift=False)


@right("completer", "a box around the visible surface")
class BoundingBox(Completer):
    def fill(self, rng, seen):
        p = np.zeros(seen.surface.shape)
        voxels = np.argwhere(seen.surface)
        if len(voxels):
            a, b = voxels.min(axis=0), voxels.max(axis=0) + 1
            p[a[0] : b[0], a[1] : b[1], : b[2]] = 0.6
        p[seen.surface] = 1
        return p


@right("completer", "the surface grows by a random number of voxels")
class Grows(Completer):
    stochastic: ClassVar[bool] = True

    def fill(self, rng, seen):
        grown = ndimage.binary_dilation(seen.surface, iterations=int(rng.integers(1, 3)))
        return np.where(seen.surface, 1.0, 0.7 * (grown & ~seen.other_surface))


@right("boundary", "steps of brightness")
class Brightness(BoundaryModel):
    def boundary(self, frame):
        return np.clip(np.hypot(*np.gradient(frame.rgb.mean(axis=2))) / 80, 0, 1).astype(np.float32)
