"""Scores of a weighted set: identities, what hedging by noise gains, and the true posterior among other forecasts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.scoring import (
    NOISE_RATES,
    FittedForecasts,
    Questions,
    draw_questions,
    forecast_table,
    leave_one_out,
    score_belief,
)
from mstfilter.scoring.forecasts import ForecastTable


def scene(seed, shape=(16, 12, 8)):
    """Two boxes at random places, and the questions about them and their surroundings."""
    rng = np.random.default_rng(seed)
    labels = np.zeros(shape, np.uint16)
    at = rng.integers(1, 4, 2)
    labels[at[0] : at[0] + 6, at[1] : at[1] + 6, :5] = 1
    labels[at[0] + 6 : at[0] + 11, at[1] : at[1] + 5, :4] = 2
    where = np.zeros(shape, bool)
    where[:14, :10, :7] = True
    return labels, draw_questions(where, 4000, rng)


def guesses(truth, rng, n=5, reach=2):
    """Hypotheses: the true objects, each shifted, one in three merged."""
    found = []
    for _ in range(n):
        guess = np.zeros_like(truth)
        for k in (1, 2):
            shift = rng.integers(-reach, reach + 1, 2)
            guess[np.roll(truth == k, tuple(shift), (0, 1))] = k
        found.append(np.where(guess > 0, 1, 0).astype(np.uint16) if rng.random() < 1 / 3 else guess)
    return found


def test_the_brier_score_is_the_mean_squared_error():
    rng = np.random.default_rng(0)
    truth, questions = scene(0)
    labels, weights = guesses(truth, rng), rng.dirichlet(np.ones(5))
    brier = np.mean((questions.forecasts(labels, weights) - questions.outcomes(truth)) ** 2)
    assert score_belief(questions, labels, weights, truth).row["brier"] == pytest.approx(brier, abs=1e-9)


def test_counts_hold_the_forecasts_and_outcomes():
    truth, questions = scene(1)
    labels = guesses(truth, np.random.default_rng(1))
    score = score_belief(questions, labels, np.full(5, 0.2), truth)
    yes = questions.outcomes(truth).sum()
    assert (score.counts.sum(axis=1) == (len(questions) - yes, yes)).all()
    for k, rate in enumerate(NOISE_RATES):
        p = questions.forecasts(labels, np.full(5, 0.2), NOISE_RATES)[k]
        table, direct = forecast_table(score.counts[k]), ForecastTable.of(p, questions.outcomes(truth))
        assert table.brier == pytest.approx(direct.brier, abs=1e-3), rate


def test_without_questions_scores_are_unknown():
    truth, _ = scene(0)
    empty = Questions(truth.shape, np.zeros(0, int), np.zeros(0, int))
    score = score_belief(empty, [truth], np.ones(1), truth)
    assert np.isnan(score.row["brier"]) and not score.counts.any()
    assert leave_one_out({"one": score.counts, "two": score.counts}) == {}
    with pytest.raises(InputError, match="1 with the weights"):
        score_belief(empty, [truth], np.ones(2) / 2, truth)


def noisy_copies(labels, rate, rng):
    """Labels of which every voxel takes that of a random neighbour with probability `rate`."""
    padded = np.pad(labels, 1, mode="edge")
    inner = (slice(1, -1),) * 3
    moved = [np.roll(padded, s, axis)[inner] for axis in range(3) for s in (-1, 1)]
    drawn = np.choose(rng.integers(6, size=labels.shape), moved)
    return np.where(rng.random(labels.shape) < rate, drawn, labels).astype(np.uint16)


def test_hedging_by_noise_lowers_the_brier_score_and_does_not_lower_the_recalibrated_log_loss():
    """Ten noisy copies of one hypothesis against the hypothesis itself, on twelve scenes."""
    plain, hedged, raw = {}, {}, []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        truth, questions = scene(seed)
        (guess,) = guesses(truth, rng, 1)
        copies = [noisy_copies(guess, 0.3, rng) for _ in range(10)]
        one = score_belief(questions, [guess], np.ones(1), truth)
        ten = score_belief(questions, copies, np.full(10, 0.1), truth)
        plain[seed], hedged[seed] = one.counts, ten.counts
        raw.append((one.row["brier"], ten.row["brier"]))
    assert all(noisy < exact for exact, noisy in raw)  # the raw score rewards the noise in every scene
    losses = [
        np.mean([fit.log_loss(counts[scene]) for scene, fit in leave_one_out(counts).items()])
        for counts in (plain, hedged)
    ]
    # The hypothesis without noise is read with the noise that is best for it: the copies know nothing more.
    assert losses[0] < losses[1] + 0.01
    assert leave_one_out(plain)[0].rate > 0


def test_leave_one_out_uses_the_other_scenes_only():
    counts = {}
    for seed in range(4):
        truth, questions = scene(seed)
        labels = guesses(truth, np.random.default_rng(seed))
        counts[seed] = score_belief(questions, labels, np.full(5, 0.2), truth).counts
    fits = leave_one_out(counts)
    for seed in counts:
        rest = FittedForecasts.fit(sum(counts[k].astype(int) for k in counts if k != seed))
        assert fits[seed].rate == rest.rate
        assert fits[seed].log_loss(counts[seed]) == rest.log_loss(counts[seed])


# A world that can be enumerated: which of four voxels in a row belong together, free voxels included.


def partitions(n):
    """All labellings of n voxels, 0 for free, objects numbered by their first voxel."""
    found = []
    for row in itertools.product(range(n + 1), repeat=n):
        order = list(dict.fromkeys(k for k in row if k))
        if order == sorted(order) and order == list(range(1, len(order) + 1)):
            found.append(np.array(row, np.uint16).reshape(n, 1, 1))
    return found


def test_the_posterior_has_the_least_expected_scores():
    """Over 1,000 other weightings of all 52 labellings of four voxels, some with noise, none does better."""
    rng = np.random.default_rng(7)
    worlds = partitions(4)
    assert len(worlds) == 52
    first, second = np.triu_indices(4, 1)
    questions = Questions((4, 1, 1), first, second)
    answers = np.stack([questions.outcomes(world) for world in worlds]).astype(float)
    posterior = rng.dirichlet(np.full(52, 0.2))

    def scores(weights):
        p = np.clip(weights @ answers, 1e-12, 1 - 1e-12)
        loss = -(posterior @ (answers * np.log(p) + (1 - answers) * np.log(1 - p))).mean()
        return loss, (posterior @ (answers - p) ** 2).mean()

    best = scores(posterior)
    for k in range(1000):
        other = rng.dirichlet(np.full(52, 0.2))
        share = rng.choice([1.0, 0.5, 0.1, 0.01])
        forecast = (1 - share) * posterior + share * (other if k % 2 else np.full(52, 1 / 52))
        assert all(a >= b - 1e-12 for a, b in zip(scores(forecast), best, strict=True))
