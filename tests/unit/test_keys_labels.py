"""Coloured keys with hidden domains: what labels are, and that IPO plays on them."""

import numpy as np
import pytest

from experiments import keys as coloured
from experiments import keys_labels
from experiments.keys import Keys, arm, returns
from experiments.keys_labels import (
    LABELLINGS,
    Cell,
    LabelledDomains,
    agreement,
    at_random,
    environments,
    inferred,
    joined,
    label_cells,
    run_labels,
    slopes_in_scale,
    starting_in,
)
from ipo.worlds.tabular import expected_return

TINY = {"num_updates": 1, "num_envs": 8, "num_steps": 16, "minibatch_size": 32, "num_epochs": 1}
IPO = arm("ipo", "ipo", **TINY)
COLORS = np.repeat([0, 1], 48)


@pytest.fixture(scope="module")
def task(tables) -> Keys:
    return Keys(tables)


@pytest.fixture(scope="module")
def pooled(task):
    return joined([task.tasks[color] for color in coloured.TRAINED])


def test_the_joined_task_is_the_mean_of_its_parts(task, pooled):
    policy = np.random.default_rng(0).dirichlet(np.ones(7), (1, 289))
    (red,), (green,) = (expected_return(task.tasks[color], policy)[0] for color in coloured.TRAINED)
    twice = np.concatenate([policy, policy], axis=1)
    assert expected_return(pooled, twice)[0] == pytest.approx((red + green) / 2, rel=1e-12)
    assert len(environments(pooled)) == 96
    first = starting_in(pooled, environments(pooled)[:48])
    assert expected_return(first, twice)[0] == pytest.approx(red, rel=1e-12)


def test_with_colours_as_labels_training_is_that_of_the_given_domains(task, pooled):
    domains = LabelledDomains(pooled, np.tile(COLORS, (2, 1)))
    *_, (_, found) = task.train_in(domains, domains.images, 2, IPO, [0, 1])
    *_, (_, given) = task.train(IPO, [0, 1])
    ours, theirs = returns(task, found), returns(task, given)
    assert all(ours[key] == pytest.approx(theirs[key], rel=1e-6) for key in theirs)


def test_every_run_has_its_own_domains(pooled):
    labels = np.stack([COLORS, np.arange(96) % 2])
    domains = LabelledDomains(pooled, labels)
    copies = domains([0, 1], [20, 20], [np.random.default_rng(run) for run in range(2)])
    copies.reset()
    size, starts = len(pooled.start), environments(pooled)
    for run in range(2):
        seen = [int(np.flatnonzero(starts == state)[0]) for state in copies.state[run] % size]
        assert labels[run][seen].tolist() == [0] * 20 + [1] * 20


@pytest.mark.parametrize(
    ("labels", "expected"), [(COLORS, 1), (1 - COLORS, 1), (np.arange(96) % 2, 0), (0 * COLORS, 0)]
)
def test_agreement_by_hand(labels, expected):
    assert agreement(labels[None], 2) == pytest.approx([expected])


@pytest.mark.parametrize("name", LABELLINGS)
def test_labels_are_two_domains_and_the_same_each_time(task, pooled, name):
    labels = LABELLINGS[name](task, pooled, IPO, [0, 1])
    assert labels.shape == (2, 96) and set(labels.ravel()) == {0, 1}
    assert np.array_equal(labels, LABELLINGS[name](task, pooled, IPO, [0, 1]))


def test_slopes_are_those_of_the_return_from_each_environment(task, pooled):
    *_, (_, players) = task.train(IPO, [0])
    (slopes,) = slopes_in_scale(task, pooled, players)
    logits = task.logits(players, pooled.images)
    for number in (0, 47, 48, 95):
        alone = starting_in(pooled, environments(pooled)[[number]])
        up, down = (
            expected_return(alone, (scale * logits).softmax(-1).numpy())[0]
            for scale in (1.01, 0.99)
        )
        assert slopes[number] == pytest.approx(float((up - down)[0]) / 0.02, rel=1e-3)


def test_inferred_halves_have_the_largest_penalty(task, pooled, monkeypatch):
    slopes = np.random.default_rng(0).standard_normal((1, 96))
    monkeypatch.setattr(keys_labels, "slopes_in_scale", lambda *_: slopes)

    def penalty(labels: np.ndarray) -> float:
        return sum(slopes[0, labels == e].mean() ** 2 for e in range(2))

    (labels,) = inferred(task, pooled, IPO, [0])
    halves = at_random(task, pooled, IPO, range(200))
    assert labels.mean() == 0.5
    assert penalty(labels) > max(map(penalty, halves))


def test_rows_of_a_cell(tables):
    cell = Cell(IPO, "random")
    rows = run_labels(cell, [0, 1], tables)
    assert set(rows["method"]) == {"ipo_random"} and len(rows) == 2 * (6 * 7 + 2)
    halves = rows[rows["metric"] == "smaller_domain"]
    assert halves["value"].tolist() == [0.5, 0.5]


def test_cells_are_of_the_published_settings():
    cells = label_cells(20)
    assert [cell.labels for cell in cells] == list(LABELLINGS)
    assert {cell.trained.settings for cell in cells} == {coloured.published("ipo")}
