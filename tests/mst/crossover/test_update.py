"""Crossover and the update: invariants, identity over time, and the authors' real weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.crossover import Crossover, CrossoverUpdate, ModeFilter, RandomOrder, SpanningTree
from mstfilter.runs.presets import REGISTRY, load_config
from mstfilter.scene import Clip, Crop, Frame, FreeSpace, Hypothesis, NoFreeSpace, Occupancy, Projection, VoxelGrid
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Population
from tests.scene.scenes import CAMERA, GRID, table_scene

SMALL = VoxelGrid((0, 0, 0), 0.01, (5, 4, 3))
labels = hnp.arrays(np.uint16, SMALL.shape, elements=st.sampled_from([0, 0, 1, 2, 3, 65535]))
NO_FILTER = ModeFilter(window=1)
crossovers = st.builds(
    Crossover,
    structure=st.sampled_from([RandomOrder(), SpanningTree()]),
    merge=st.sampled_from(["share", "printed", "always", "never"]),
    mode_filter=st.just(NO_FILTER),
)


@settings(max_examples=60, deadline=None)
@given(labels, labels, crossovers, st.integers(0, 1000))
def test_crossover_carries_probabilities(a, b, crossover, seed):
    """The labels do not depend on them. A voxel gets no more than its parents say, and half at least for a label."""
    rng = np.random.default_rng(seed)
    sure = [Hypothesis.from_labels(a, SMALL, birth=1), Hypothesis.from_labels(b, SMALL, birth=0)]
    unsure = [
        replace(h, occupancy=Occupancy(h.labels, np.where(h.labels > 0, rng.uniform(0.5, 1, SMALL.shape), 0)))
        for h in sure
    ]
    child = crossover.cross(np.random.default_rng(seed), *unsure)
    np.testing.assert_array_equal(child.labels, crossover.cross(np.random.default_rng(seed), *sure).labels)
    p = child.shares.probability
    assert (p[child.labels > 0] >= 0.5).all() and (p[child.labels == 0] <= 0.5).all()
    assert (p <= np.maximum(*(h.shares.probability for h in unsure))).all()
    np.testing.assert_array_equal(child.shares.owner[child.labels > 0], child.labels[child.labels > 0])
    same = crossover.cross(np.random.default_rng(seed), unsure[0], replace(unsure[0]))
    if crossover.merge != "always" and (same.labels > 0).any():
        np.testing.assert_array_equal(same.shares.probability[same.labels > 0], unsure[0].shares.probability[a > 0])


@settings(max_examples=60, deadline=None)
@given(labels, labels, crossovers, st.integers(0, 1000))
def test_objects_of_both_parents_have_different_ids(a, b, crossover, seed):
    """Also if the parents use the same ids, as without `birth`. Predicted objects keep theirs."""
    proposed, predicted = Hypothesis.from_labels(a, SMALL), Hypothesis.from_labels(b, SMALL)
    child = crossover.cross(np.random.default_rng(seed), proposed, predicted)
    assert len({o.id for o in child.objects}) == child.n_objects
    apart = crossover.cross(np.random.default_rng(seed), proposed.born_at(1), predicted)
    kept, known = {o.id for o in child.objects}, {o.id for o in predicted.objects}
    if predicted.objects and proposed.objects:
        assert kept & known == {o.id for o in apart.objects} & known


def test_the_update_gives_new_objects_the_ids_of_its_pause():
    """An id is not given again, even if its object was lost before."""
    a, b = np.zeros(GRID.shape, np.uint16), np.zeros(GRID.shape, np.uint16)
    a[:3, :3, :3], b[10:13, :3, :3], b[20:23, :3, :3] = 2, 1, 2
    predicted, proposed = (Population((Hypothesis.from_labels(one, GRID),)) for one in (a, b))
    update = CrossoverUpdate(NoFreeSpace(), Crossover(mode_filter=NO_FILTER))
    found = update.update(np.random.default_rng(0), predicted, proposed, clip(7))
    assert {o.id for o in found.particles[0].objects} == {2, 7 * 65536 + 1, 7 * 65536 + 2}
    assert {o.birth for o in found.particles[0].objects} == {0, 7}


@settings(max_examples=150, deadline=None)
@given(labels, labels, crossovers, st.integers(0, 1000))
def test_crossover_invariants(a, b, crossover, seed):
    """The child occupies the union of its parents, and its objects are objects of its parents."""
    proposed, predicted = Hypothesis.from_labels(a, SMALL, birth=1), Hypothesis.from_labels(b, SMALL, birth=0)
    child = crossover.cross(np.random.default_rng(seed), proposed, predicted)
    np.testing.assert_array_equal(child.labels > 0, (a > 0) | (b > 0))
    ids = {o.id for h in (proposed, predicted) for o in h.objects}
    assert {o.id for o in child.objects} <= ids
    assert len({o.id for o in child.objects}) == len(child.objects)
    # An object without conflict keeps one label.
    for hypothesis, other in ((proposed, b), (predicted, a)):
        for record in hypothesis.objects:
            mask = hypothesis.labels == record.label
            if not other[mask].any():
                assert len(np.unique(child.labels[mask])) == 1
    again = crossover.cross(np.random.default_rng(seed), proposed, predicted)
    np.testing.assert_array_equal(child.labels, again.labels)
    if crossover.merge == "never":
        assert child.n_objects <= proposed.n_objects + predicted.n_objects


@settings(max_examples=60, deadline=None)
@given(labels, st.integers(0, 1000))
def test_equal_parents_and_empty_parents(a, seed):
    """Equal parents give the same scene; with an empty parent the result is the other one."""
    rng = np.random.default_rng(seed)
    crossover = Crossover(merge="share", mode_filter=NO_FILTER)
    one, two = Hypothesis.from_labels(a, SMALL, birth=3), Hypothesis.from_labels(a, SMALL)
    child = crossover.cross(rng, one, two)
    assert weighted_coverage(child.labels, a) == 1.0
    nothing = Hypothesis.from_labels(np.zeros(SMALL.shape, np.uint16), SMALL)
    assert crossover.cross(rng, one, nothing) is one
    assert crossover.cross(rng, nothing, two) is (two if two.objects else nothing)


def test_identity_and_motion_history():
    """The largest predicted object gives the id. The history is kept if the voxels are exactly those predicted."""
    a, b = np.zeros(SMALL.shape, np.uint16), np.zeros(SMALL.shape, np.uint16)
    b[0, :3], b[4, 0] = 1, 2
    a[0, :3, 0], a[2, 2, 2], a[3:, 0] = 5, 6, 7
    predicted = Hypothesis.from_labels(b, SMALL)
    moved = RigidTransform.from_translation([0.01, 0, 0])
    records = tuple(replace(o, source=Crop.of(b == o.label), motion=moved) for o in predicted.objects)
    predicted = Hypothesis(b, SMALL, records)
    proposed = Hypothesis.from_labels(a, SMALL, birth=2)
    child = Crossover(merge="always", mode_filter=NO_FILTER).cross(np.random.default_rng(0), proposed, predicted)
    assert sorted(o.id for o in child.objects) == [1, 2, 2 * 65536 + 6]
    by_id = {o.id: o for o in child.objects}
    assert by_id[1].source is not None  # swallowed a part of itself: unchanged
    assert by_id[2].source is None  # it has grown
    assert np.allclose(by_id[2].motion.as_matrix(), np.eye(4))
    assert by_id[2 * 65536 + 6].source is None
    assert by_id[2 * 65536 + 6].birth == 2


def clip(t=1):
    rgb, depth, _ = table_scene()
    return Clip((Frame(rgb, depth, CAMERA),), GRID, t)


def populations():
    _, _, truth = table_scene()
    rng = np.random.default_rng(0)
    first = Hypothesis.from_labels(truth, GRID)
    merged = Hypothesis.from_labels((truth > 0).astype(np.uint16), GRID)
    predicted = Population((first, merged), np.log([0.3, 0.7]), {"previous": np.array([1, 0])})
    samples = tuple(
        Hypothesis.from_labels(np.where(truth > 0, truth + k, 0).astype(np.uint16), GRID, 1) for k in range(3)
    )
    return predicted, Population(samples, rng.normal(size=3), {"proposed": np.arange(3)})


def test_candidates_of_all_pairs():
    predicted, proposed = populations()
    fused = CrossoverUpdate(eta=4).update(np.random.default_rng(0), predicted, proposed, clip())
    assert len(fused) == 3 * 2 * 4
    assert fused.particles.n_built == 0
    i, j = fused.parents["proposed"], fused.parents["previous"]
    back = np.array([1, 0])
    np.testing.assert_allclose(
        fused.log_weights, proposed.log_weights[i] + predicted.log_weights[back[j]], atol=1e-12
    )
    assert sorted(set(zip(i.tolist(), j.tolist(), strict=True))) == [(a, b) for a in range(3) for b in range(2)]


def test_lazy_and_eager_candidates_are_the_same():
    """Building all and then choosing gives exactly what choosing and then building gives."""
    predicted, proposed = populations()
    lazy = CrossoverUpdate(eta=3).update(np.random.default_rng(5), predicted, proposed, clip())
    eager = CrossoverUpdate(eta=3).update(np.random.default_rng(5), predicted, proposed, clip()).realised()
    chosen = np.array([3, 17, 3, 0])
    for a, b in zip(lazy.take(chosen).realised().particles, eager.take(chosen).particles, strict=True):
        np.testing.assert_array_equal(a.labels, b.labels)


def test_without_prediction_the_samples_pass():
    _, proposed = populations()
    fused = CrossoverUpdate().update(np.random.default_rng(0), None, proposed, clip(0))
    assert fused.particles is proposed.particles
    nothing = Hypothesis.from_labels(np.zeros(GRID.shape, np.uint16), GRID)
    fused = CrossoverUpdate(eta=1).update(np.random.default_rng(0), Population((nothing,)), proposed, clip())
    for candidate, sample in zip(fused.particles, proposed.particles, strict=True):
        assert candidate is sample


def test_without_a_proposal_it_is_the_manifold_filter():
    """Predictions are projected onto free space, and weighted by Q^lambda; one that loses all keeps a weight."""
    predicted, _ = populations()
    nowhere = np.zeros(GRID.shape, np.uint16)
    nowhere[30, 5, 20] = 1
    both = Population((predicted.particles[0], Hypothesis.from_labels(nowhere, GRID)), None, predicted.parents)
    fused = CrossoverUpdate(quality_exponent=2.0).update(np.random.default_rng(0), both, None, clip())
    wanted = FreeSpace().refine(both.particles, clip())[0]
    assert [h.key for h in fused.particles] == [h.key for h in wanted]
    assert fused.notes["quality"] == [1.0, 0.0]
    np.testing.assert_allclose(np.diff(fused.log_weights), [2 * np.log(1e-3)])
    np.testing.assert_array_equal(fused.parents["previous"], [1, 0])


def test_the_authors_real_particles(shared_data):
    """The Update of the preset `authors` on their real particles.

    log w = W[0, j] + W[1, i] + 3 ln Q_j gives back weights (residual 0.0) and parents of all five shipped
    estimates; occupied(estimate) is measured union refined; and the filter's own candidates have these weights.
    """
    folder = shared_data("r1")
    measured, refined, estimate = (
        np.load(folder / f"{n}.npz") for n in ("measurement", "freespace_refined", "estimate")
    )
    grid = VoxelGrid(measured["region_min"], 0.01, (61, 61, 41))
    samples = tuple(Hypothesis.from_labels(m, grid, 1) for m in measured["labels"][1, :5])
    predictions = tuple(Hypothesis.from_labels(m, grid) for m in refined["labels"][0])
    quality = refined["weight"][0]
    proposed = Population(samples, measured["weight"][1, :5], {"proposed": np.arange(5)})

    config = load_config("authors", ["update.free_space=none"])
    update = REGISTRY.build("update", config["update"])
    assert isinstance(update.free_space, NoFreeSpace)
    # The data contain no depth: the projection returns the Q of the data.
    update = replace(update, free_space=ShippedQuality({h.key: q for h, q in zip(predictions, quality, strict=True)}))
    predicted = Population(predictions, measured["weight"][0, :5], {"previous": np.arange(5)})
    rgb, depth, _ = table_scene()
    fused = update.update(np.random.default_rng(0), predicted, proposed, Clip((Frame(rgb, depth, CAMERA),), grid, 1))
    assert len(fused) == 125

    pair = {}
    for k in range(125):
        pair.setdefault((int(fused.parents["proposed"][k]), int(fused.parents["previous"][k])), k)
    expected = [(0, 1), (1, 2), (2, 2), (1, 4), (0, 1)]
    shipped = estimate["weight"][0]
    for m, (i, j) in enumerate(expected):
        matching = [p for p, k in pair.items() if abs(fused.log_weights[k] - shipped[m]) < 1e-9]
        assert matching == [(i, j)]
        assert fused.log_weights[pair[i, j]] - shipped[m] == 0.0
        union = (samples[i].labels > 0) | (predictions[j].labels > 0)
        np.testing.assert_array_equal(estimate["labels"][0, m] > 0, union)
        ours = fused.particles[pair[i, j]]
        # Ours has the same occupancy but for what the mode filter sets free at isolated voxels.
        assert (ours.labels[~union] == 0).all()
        assert ((ours.labels > 0) == union).mean() > 0.9999

    resampler = REGISTRY.build("resampler", config["resampler"])
    kept = resampler.resample(np.random.default_rng(1), fused, 5).realised()
    assert len(kept) == 5
    assert all(isinstance(h, Hypothesis) and h.objects for h in kept.particles)
    np.testing.assert_array_equal(kept.log_weights, fused.log_weights[kept.parents["ancestor"]])


@pytest.mark.parametrize(("n", "n_proposed"), [(2, 4), (5, 5), (10, 20)])
def test_systematic_resampling_reaches_many_parents(n, n_proposed):
    """With equal weights, no stride through the candidates meets one prediction again and again.

    n independent draws would reach n (1 - (1 - 1/n)^n) predictions on average; ours must reach as many, within 4
    standard errors of 60 runs (false alarm below 1e-4 a case), and all of them where there are as many samples.
    """
    from mstfilter.smc import Systematic

    hypothesis = Hypothesis.from_labels(np.ones(SMALL.shape, np.uint16), SMALL)
    predicted = Population((hypothesis,) * n, None, {"previous": np.arange(n)})
    proposed = Population((hypothesis,) * n_proposed, None, {"proposed": np.arange(n_proposed)})
    reached = []
    for seed in range(60):
        fused = CrossoverUpdate(free_space=NoFreeSpace()).update(
            np.random.default_rng(seed), predicted, proposed, clip()
        )
        chosen = Systematic().resample(np.random.default_rng(seed), fused, n)
        assert len(set(chosen.parents["proposed"].tolist())) == min(n, n_proposed)
        reached.append(len(set(chosen.parents["previous"].tolist())))
    if n_proposed == n:
        assert set(reached) == {n}
    assert np.mean(reached) > n * (1 - (1 - 1 / n) ** n) - 4 * max(np.std(reached), 0.3) / np.sqrt(60)


@dataclass(frozen=True)
class ShippedQuality(Projection):
    """Returns the quality of the data, by the key of the hypothesis."""

    by_key: dict

    def project(self, hypothesis, frame):
        return hypothesis, self.by_key[hypothesis.key]


def test_the_drop_rule_drops_late_objects_without_conflict():
    """An object without conflict whose first voxel follows those of all objects in conflict."""
    a, b = np.zeros(SMALL.shape, np.uint16), np.zeros(SMALL.shape, np.uint16)
    a[0, 0, 0], b[:2, 0, 0], b[4, 3, 2] = 1, 1, 2  # label 2 stands alone, at the end of the scan
    proposed, predicted = Hypothesis.from_labels(a, SMALL, 1), Hypothesis.from_labels(b, SMALL)
    for drop, left in ((False, True), (True, False)):
        crossover = Crossover(mode_filter=NO_FILTER, drop_rule=drop)
        child = crossover.cross(np.random.default_rng(0), proposed, predicted)
        assert bool(child.labels[4, 3, 2]) == left
    b[4, 3, 2], b[0, 3, 2] = 0, 0
    a[4, 0, 0] = 1  # the conflict now reaches beyond nothing loose: nothing to drop
    same = Crossover(mode_filter=NO_FILTER, drop_rule=True).cross(
        np.random.default_rng(0), Hypothesis.from_labels(a, SMALL, 1), Hypothesis.from_labels(b, SMALL)
    )
    assert ((same.labels > 0) == ((a > 0) | (b > 0))).all()
