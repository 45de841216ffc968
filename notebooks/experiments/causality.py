"""From a configuration of the invariance experiments to tidy rows: linear data, coloured digits.

Three problems: the linear example of Arjovsky et al. (2019) in its eight variants, digits coloured
in their manner, and small problems built to make the methods fail. All data comes from structural
causal models, of which domains are interventions that leave the target alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import sklearn.datasets
import torch
from torch import Tensor

from experiments import figures
from experiments.experiment import Experiment, near_the_end
from experiments.rows import tidy
from experiments.store import select
from ipo.causality.icp import icp
from ipo.causality.predictors import (
    PREDICTOR_METHODS,
    Classification,
    PredictorSettings,
    Regression,
)
from ipo.causality.scm import SCM, Linear, Normal, moments, population_regression
from ipo.checks import check_choice, check_number

DIM = 5  # causes, and as many effects, in the linear example
SCALES = (0.2, 2.0, 5.0)  # its training domains
VARIANTS = tuple(f + o + u for f in "FP" for o in "OE" for u in "US")
NUM_SAMPLES = 1000  # per domain of the linear problems
NUM_TEST = 20_000  # where the risk has no closed form
COLOR_AGREES = (0.9, 0.8)  # how often the colour goes with the label, in training
LABEL_NOISE = 0.25
PROBLEMS = ("few_domains", "small_shift", "marked_domains")
Domain = tuple[np.ndarray, np.ndarray]  # features [N, d], targets [N]


@dataclass(frozen=True)
class Cell:
    """A method on a problem.

    Attributes:
        method: one of :data:`ipo.causality.predictors.PREDICTOR_METHODS`, ``icp`` or ``oracle``.
        problem: one of :data:`VARIANTS` or :data:`PROBLEMS`, or ``digits``.
        level: what a problem of :data:`PROBLEMS` varies; zero otherwise.
        settings: how the method is trained; ``None`` for what is not trained by steps.
    """

    method: str
    problem: str
    settings: PredictorSettings | None
    level: float = 0.0

    def __post_init__(self) -> None:
        check_choice("method", self.method, (*PREDICTOR_METHODS, "icp", "oracle"))
        check_choice("problem", self.problem, (*VARIANTS, *PROBLEMS, "digits"))
        check_number("level", self.level, least=0)
        if (self.settings is None) != (self.method in ("icp", "oracle")):
            raise ValueError(
                f"settings = {self.settings!r}: must be given, but not for icp, oracle"
            )

    @property
    def columns(self) -> dict[str, Any]:
        return {
            "problem": self.problem,
            "level": self.level,
            "method": self.method,
            "penalty": self.settings.penalty if self.settings else 0.0,
        }


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Train and evaluate all runs of a cell."""
    if cell.problem == "digits":
        metrics = _run_digits(cell, seeds)
    elif cell.problem in VARIANTS:
        metrics = _run_chain(cell, seeds)
    else:
        metrics = _run_small(cell, seeds)
    return tidy(cell, seeds, metrics)


# --------------------------------------------------------- the linear example of the IRM paper


def chain(variant: str, scale: float, weights: Sequence[np.ndarray], reverse: bool = False) -> SCM:
    """The linear example: hidden H, causes X1, target Y, effects X2, each of dimension 5.

        H ~ N(0, e^2),  X1 = H W1 + N(0, e^2),  Y_i = X1_i + (H W2)_i + N(0, s^2),
        X2_i = Y_i + (H W3)_i + N(0, t^2),      Y = sum_i Y_i

    Args:
        variant: three letters. F: all observed, W2 = W3 = 0 and W1 = 1; P: partially, random W.
            O: homoskedastic, s = 1 and t = e; E: heteroskedastic, s = e and t = 1.
            U or S: seen as they are, or scrambled (by the caller).
        scale: the factor e.
        weights: W1, W2, W3.
        reverse: turn the sign of everything that X2 follows.

    Source: Section 5.1 of Arjovsky et al. (2019), and the authors' code for the letters O and E.
    """
    check_choice("variant", variant, VARIANTS)
    check_number("scale", scale, above=0)
    std_y, std_x2 = (scale, 1.0) if variant[1] == "E" else (1.0, scale)
    sign = -1.0 if reverse else 1.0
    units = range(DIM)
    model: dict[str, Linear] = {f"H{i}": Linear({}, Normal(0, scale)) for i in units}

    def from_hidden(matrix: np.ndarray, i: int, sign: float = 1.0) -> dict[str, float]:
        return {f"H{j}": sign * matrix[j, i] for j in units if matrix[j, i]}

    for i in units:
        model[f"X1_{i}"] = Linear(from_hidden(weights[0], i), Normal(0, scale))
        model[f"Y{i}"] = Linear({f"X1_{i}": 1} | from_hidden(weights[1], i), Normal(0, std_y))
        model[f"X2_{i}"] = Linear(
            {f"Y{i}": sign} | from_hidden(weights[2], i, sign), Normal(0, std_x2)
        )
    model["Y"] = Linear({f"Y{i}": 1.0 for i in units}, Normal(0, 0))
    return SCM(model)


FEATURES = [f"X{k}_{i}" for k in (1, 2) for i in range(DIM)]
CAUSAL = np.repeat([1.0, 0.0], DIM)  # the predictor from the causes


def chain_run(variant: str, seed: int) -> tuple[list[Domain], tuple[Tensor, ...], np.ndarray]:
    """Training domains of a run, moments of its test domain, and the matrix that scrambles.

    In the test domain e = 1, and the effects follow the target with the opposite sign.
    """
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
    weights = [streams[0].standard_normal((DIM, DIM)) / (2 * DIM) for _ in range(3)]
    rotation = np.linalg.qr(streams[1].standard_normal((2 * DIM, 2 * DIM)))[0]
    if variant[0] == "F":
        weights = [np.eye(DIM), np.zeros((DIM, DIM)), np.zeros((DIM, DIM))]
    if variant[2] == "U":
        rotation = np.eye(2 * DIM)
    domains = []
    for scale, rng in zip(SCALES, streams[2:], strict=True):
        samples = chain(variant, scale, weights).sample(NUM_SAMPLES, rng)
        domains.append((samples[FEATURES].to_numpy() @ rotation, samples["Y"].to_numpy()))
    test = population(chain(variant, 1.0, weights, reverse=True), FEATURES)
    return domains, test, rotation


def population(model: SCM, features: Sequence[str], target: str = "Y") -> tuple[Tensor, ...]:
    """Second moments A, b, c of a linear model with mean zero: infinitely many samples."""
    _, covariance = moments(model)
    parts = (covariance.loc[features, features], covariance.loc[features, target])
    return (
        *(torch.tensor(p.to_numpy()) for p in parts),
        torch.tensor(covariance.loc[target, target]),
    )


def _run_chain(cell: Cell, seeds: list[int]) -> dict[tuple[str, str], Tensor]:
    """IRMv1 and V-REx train in two domains and keep the third for choosing their penalty."""
    runs = [chain_run(cell.problem, seed) for seed in seeds]
    features, targets = stack([domains for domains, _, _ in runs])
    rotations = np.stack([rotation for _, _, rotation in runs])
    num_train = 2 if cell.method in ("irmv1", "vrex") else 3
    v = fit(cell, features[:num_train], targets[:num_train], causal=CAUSAL @ rotations)
    return chain_metrics(runs, v, num_train)


def chain_metrics(
    runs: Sequence[tuple[list[Domain], tuple[Tensor, ...], np.ndarray]],
    v: Tensor,
    num_train: int = 3,
) -> dict[tuple[str, str], Tensor]:
    """What coefficients ``v [R, d]`` of the runs of :func:`chain_run` come to."""
    task = Regression.from_samples(*stack([domains for domains, _, _ in runs]))
    test = Regression(*(torch.stack([t[i] for _, t, _ in runs]).unsqueeze(1) for i in range(3)))
    risks = task.risks(v)
    rotations = torch.tensor(np.stack([rotation for _, _, rotation in runs]))
    v = (rotations @ v.unsqueeze(-1)).squeeze(-1)  # coefficients of X1 and X2 themselves
    errors = (v - torch.tensor(CAUSAL)).square()
    return {
        ("train", "train_risk"): risks[:, :num_train].mean(1),
        ("held_out", "validation_risk"): risks[:, 2],
        ("test", "test_risk"): test.risks(v).squeeze(1),
        ("all", "error_causal"): errors[:, :DIM].mean(1),
        ("all", "error_effects"): errors[:, DIM:].mean(1),
    }


def fit(cell: Cell, features: list[Tensor], targets: list[Tensor], causal: np.ndarray) -> Tensor:
    """The coefficients ``[R, d]`` that a cell's method finds."""
    if cell.method == "oracle":
        return torch.tensor(np.broadcast_to(causal, (len(features[0]), causal.shape[-1])).copy())
    if cell.method == "icp":
        runs = [
            icp([x[r] for x in features], [y[r] for y in targets]) for r in range(len(features[0]))
        ]
        return torch.tensor(np.stack([run.coefficients for run in runs]))
    return PREDICTOR_METHODS[cell.method](Regression.from_samples(features, targets), cell.settings)


def stack(runs: Sequence[Sequence[Domain]]) -> tuple[list[Tensor], list[Tensor]]:
    """``runs[r][e] = (features, targets)`` -> features ``[R, N, d]``, targets, for every e."""
    domains = list(zip(*runs, strict=True))
    features = [torch.tensor(np.stack([x for x, _ in domain])) for domain in domains]
    return features, [torch.tensor(np.stack([y for _, y in domain])) for domain in domains]


# -------------------------------------------------------------------- problems made to fail


def anticausal(slopes: Sequence[float], scale: float = 1.0, marker: float = 0.0) -> SCM:
    """A cause, the target, its effects, and a marker that only says which domain this is.

    X ~ N(0, scale^2),  Y = X + N(0, 1),  Z_j = slopes[j] Y + N(0, 1),  M = marker + N(0, 1)
    """
    effects = {f"Z{j}": Linear({"Y": float(slope)}) for j, slope in enumerate(slopes)}
    rest = {
        "X": Linear({}, Normal(0, scale)),
        "Y": Linear({"X": 1.0}),
        "M": Linear({}, Normal(marker, 1.0)),
    }
    return SCM(rest | effects)


def small_domains(
    problem: str, level: float, seed: int
) -> Iterator[tuple[SCM, np.random.Generator]]:
    """Training domains of a run, and last the test domain, where every slope is -1."""
    rng, *streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(64)]
    if problem == "few_domains":  # level: number of domains, with three effects
        domains = [(rng.normal(1, 1, 3), rng.uniform(0.5, 2), 0.0) for _ in range(int(level))]
    elif problem == "small_shift":  # level: how far four domains go apart, up or down from 1
        domains = [([1 + s * level], 2 ** (s * level), 0.0) for s in (-1, -0.3, 0.3, 1)]
    else:  # marked_domains: how far apart the means of three domains' markers are
        domains = [([2.0], 1.5, level), ([0.5], 1.0, 0.0), ([-0.5], 0.7, -level)]
    for domain, stream in zip(domains, streams, strict=False):
        yield anticausal(*domain), stream
    yield anticausal(-np.ones(3 if problem == "few_domains" else 1)), streams[-1]


def _run_small(cell: Cell, seeds: list[int]) -> dict[tuple[str, str], Tensor]:
    runs = []
    for seed in seeds:
        *train, (test, rng) = small_domains(cell.problem, cell.level, seed)
        models = [(model, stream, NUM_SAMPLES) for model, stream in train]
        runs.append(
            [
                _features(cell, model.sample(size, stream))
                for model, stream, size in [*models, (test, rng, NUM_TEST)]
            ]
        )
    features, targets = stack(runs)
    causal = np.eye(features[0].shape[-1])[0]
    v = fit(cell, features[:-1], targets[:-1], causal)
    risks = Regression.from_samples(features, targets).risks(v)
    return {
        ("train", "train_risk"): risks[:, :-1].mean(1),
        ("test", "test_risk"): risks[:, -1],
    }


def _features(cell: Cell, samples: pd.DataFrame) -> Domain:
    """X and the effects; with marked domains also their products with the marker and its square."""
    x = samples.drop(columns=["Y", "M"]).to_numpy()
    if cell.problem == "marked_domains":
        # In units of its spread over all domains, so that the features are of similar size.
        marker = samples[["M"]].to_numpy() / np.hypot(1, cell.level)
        x = np.hstack([x, x * marker, x * marker**2])
    return x, samples["Y"].to_numpy()


# --------------------------------------------------------------------------- coloured digits


def digits_run(seed: int, gray: bool = False) -> Mapping[str, list[Domain]]:
    """Coloured digits of a run: ``train`` and ``validation`` in two domains, ``test`` in one.

    Each image of scikit-learn's 8x8 digits is used once. Its label says whether the digit is 5
    or more, and is wrong with probability 0.25; its colour agrees with the label with probability
    0.9 or 0.8 in training, 0.1 in the test. The features are the image in its colour's channel,
    zeros in the other one, and a one. A gray image is in both channels.
    """
    order, noise, color = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    images, digit = sklearn.datasets.load_digits(return_X_y=True)
    chosen = order.permutation(len(images))
    label = (digit >= 5) ^ (noise.random(len(images)) < LABEL_NOISE)
    uniform = color.random(len(images))

    def domain(part: np.ndarray, agrees: float) -> Domain:
        red = label[part] ^ (uniform[part] >= agrees)
        x = images[part] / 16
        channels = (x, x) if gray else (x * red[:, None], x * ~red[:, None])
        return np.hstack([*channels, np.ones((len(part), 1))]), label[part].astype(float)

    third = len(images) // 3
    test = domain(chosen[2 * third :], 1 - COLOR_AGREES[0])
    parts = [chosen[:third], chosen[third : 2 * third]]
    num_train = third * 4 // 5
    return {
        "train": [domain(p[:num_train], a) for p, a in zip(parts, COLOR_AGREES, strict=True)],
        "validation": [domain(p[num_train:], a) for p, a in zip(parts, COLOR_AGREES, strict=True)],
        "test": [test],
    }


def _run_digits(cell: Cell, seeds: list[int]) -> dict[tuple[str, str], Tensor]:
    """The oracle is ERM on gray images, which hold no colour that it could rely on."""
    oracle = cell.method == "oracle"
    method, settings = ("erm", DIGITS) if oracle else (cell.method, cell.settings)
    runs = [digits_run(seed, gray=oracle) for seed in seeds]
    task = {
        name: Classification(
            *([part.float() for part in parts] for parts in stack([run[name] for run in runs]))
        )
        for name in runs[0]
    }
    v = PREDICTOR_METHODS[method](task["train"], settings)
    risks = task["validation"].risks(v)
    return {
        ("train", "train_error"): task["train"].errors(v).mean(1),
        ("validation", "validation_error"): task["validation"].errors(v).mean(1),
        ("validation", "validation_risk"): risks.mean(1),
        ("validation", "validation_risk_gap"): (risks[:, 0] - risks[:, 1]).abs(),
        ("test", "test_error"): task["test"].errors(v).squeeze(1),
    }


# Nothing here was tuned on a test domain: the ridge was set once, for ERM on gray images.
DIGITS = PredictorSettings(ridge=0.01, learning_rate=0.03, num_iterations=1000)
CHAIN = PredictorSettings(learning_rate=0.003, num_iterations=5000, num_features=2 * DIM)
SMALL = PredictorSettings(learning_rate=0.02, num_iterations=3000)


def short(cell: Cell) -> Cell | None:
    """Thirty iterations, in three variants of the linear example and at some levels."""
    if cell.problem in VARIANTS and cell.problem not in ("FOU", "FEU", "PES"):
        return None
    if cell.problem in PROBLEMS and cell.level not in (0.0, 0.3, 1.8, 3.0, 8.0):
        return None
    if cell.settings is None:
        return cell
    return replace(cell, settings=replace(cell.settings, num_iterations=30))


EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short, near_the_end=near_the_end)
    for name in ("linear", "digits", "failures")
}

# ------------------------------------------------------------------ cells of the experiments

FAILURE_METHODS = ("erm", "icp", "irmv1", "vrex", "irm_game_fixed_phi")


def penalized(
    problem: str, settings: PredictorSettings, penalties: Sequence[float], level: float = 0.0
) -> list[Cell]:
    """IRMv1 and V-REx with every weight of their penalty."""
    return [
        Cell(method, problem, replace(settings, penalty=penalty), level)
        for method in ("irmv1", "vrex")
        for penalty in penalties
    ]


def linear_cells(
    variants: Sequence[str], num_iterations: int, penalties: Sequence[float]
) -> list[Cell]:
    """All methods on variants of the linear example."""
    settings = replace(CHAIN, num_iterations=num_iterations)
    return [
        cell
        for variant in variants
        for cell in (
            Cell("oracle", variant, None),
            Cell("icp", variant, None),
            Cell("erm", variant, settings),
            Cell("irm_game_fixed_phi", variant, settings),
            Cell("irm_game_variable_phi", variant, settings),
            *penalized(variant, settings, penalties),
        )
    ]


def digit_cells(num_iterations: int, penalties: Sequence[float]) -> list[Cell]:
    """All methods but ICP, which would have to test 2^128 sets, on the coloured digits."""
    settings = replace(DIGITS, num_iterations=num_iterations)
    return [
        Cell("oracle", "digits", None),
        Cell("erm", "digits", settings),
        Cell("irm_game_fixed_phi", "digits", settings),
        Cell("irm_game_variable_phi", "digits", replace(settings, num_features=10)),
        *penalized("digits", settings, penalties),
    ]


def failure_cells(levels: Mapping[str, Sequence[float]], num_iterations: int) -> list[Cell]:
    """:data:`FAILURE_METHODS` on the problems made to fail, at ``levels[problem]``."""
    settings = replace(SMALL, num_iterations=num_iterations)
    return [
        cell
        for problem, values in levels.items()
        for level in map(float, values)
        for cell in (
            Cell("icp", problem, None, level),
            Cell("erm", problem, settings, level),
            Cell("irm_game_fixed_phi", problem, settings, level),
            *penalized(problem, settings, [100.0], level),
        )
    ]


# ----------------------------------------------- which rows a table shows, and under which name


def not_chosen(rows: pd.DataFrame, penalty: float) -> pd.DataFrame:
    """IRMv1 and V-REx with one given penalty, as methods ``irmv1_strong`` and ``vrex_strong``."""
    fixed = rows[rows["method"].isin(["irmv1", "vrex"]) & (rows["penalty"] == penalty)]
    return fixed.assign(method=fixed["method"] + "_strong")


def relative_to_causes(rows: pd.DataFrame) -> pd.DataFrame:
    """Test risks divided by that of the predictor from the causes, the oracle, in the same run."""
    test = rows[rows["metric"] == "test_risk"]
    base = test[test["method"] == "oracle"].set_index(["problem", "run"])["value"]
    index = pd.MultiIndex.from_frame(test[["problem", "run"]])
    return test.assign(value=test["value"].to_numpy() / base.loc[index].to_numpy())


def table_names(strong: float) -> dict[str, str]:
    """Names in tables, in their order; ``strong`` is the penalty that nobody chose."""
    label, not_chosen = figures.label, f"λ = {strong:.0f}, not chosen"
    return {
        "erm": label("erm"),
        "icp": label("icp"),
        "irmv1": f"{label('irmv1')}, λ chosen",
        "irmv1_strong": f"{label('irmv1')}, {not_chosen}",
        "vrex": f"{label('vrex')}, λ chosen",
        "vrex_strong": f"{label('vrex')}, {not_chosen}",
        "irm_game_fixed_phi": label("irm_game_fixed_phi"),
        "irm_game_variable_phi": label("irm_game_variable_phi"),
    }


def beside_the_authors(
    selected: pd.DataFrame, paper: pd.DataFrame, names: Mapping[str, str]
) -> pd.DataFrame:
    """Mean squared errors of the coefficients, ours and theirs, in the variants that both have."""
    lines = []
    for (variant, method), theirs in paper.groupby(["variant", "method"], sort=False):
        mine = select(selected, {"problem": variant, "method": method})
        if len(mine):
            line = {"variant": variant, "method": names[method]}
            for part, column in (("causes", "error_causal"), ("effects", "error_effects")):
                line[f"{part}, ours"] = mine[mine["metric"] == column]["value"].mean()
                line[f"{part}, theirs"] = theirs[column].mean()
            lines.append(line)
    return pd.DataFrame(lines)


# ------------------------------------------------------------------------ numbers of the prose


def linear_numbers(compared: pd.DataFrame, **variants: str) -> dict[str, Any]:
    """Mean relative test errors of all methods, ``<name>_<method>`` for each ``name=variant``.

    Of ICP in the variant ``first`` also the median, and how many runs missed the causes: they have
    more than twice the causes' error, as a prediction of zero has.
    """
    numbers: dict[str, Any] = dict(variants)
    for name, variant in variants.items():
        for method in table_names(0):
            numbers[f"{name}_{method}"] = mean_value(compared, method=method, problem=variant)
    icp_runs = select(compared, {"method": "icp", "problem": variants["first"]})["value"]
    return numbers | {"icp_missed": (icp_runs > 2).sum(), "icp_median": icp_runs.median()}


def digit_numbers(
    compared: pd.DataFrame, digits: pd.DataFrame, **weights: float
) -> dict[str, float]:
    """Mean test errors, and those of the penalised methods with each ``name=weight``."""
    errors = compared[compared["metric"] == "test_error"].groupby("method")["value"].mean()
    tests = digits[digits["metric"] == "test_error"]
    by_weight = tests.groupby(["method", "penalty"])["value"].mean()
    return {f"digits_{method}": value for method, value in errors.items()} | {
        f"{name}{end}": value
        for name, weight in weights.items()
        for end, value in (
            ("", weight),
            ("_irmv1", by_weight["irmv1", weight]),
            ("_vrex", by_weight["vrex", weight]),
        )
    }


def failure_numbers(failures: pd.DataFrame) -> dict[str, float]:
    """Mean test errors at the lowest and the highest level of each problem.

    Also the level where IRMv1 is worst on small shifts, and ICP on marked domains, and what all
    methods come to there.
    """
    numbers = {}
    for name, problem, watched in (
        ("few", "few_domains", None),
        ("shift", "small_shift", "irmv1"),
        ("marked", "marked_domains", "icp"),
    ):
        rows = select(failures, {"problem": problem, "metric": "test_risk"})
        levels = sorted(rows["level"].unique())
        places = {"first": levels[0], "last": levels[-1]}
        if watched:
            errors = [mean_value(rows, method=watched, level=level) for level in levels]
            numbers[f"{name}_worst"] = places["worst"] = levels[int(np.argmax(errors))]
        for place, level in places.items():
            for method in FAILURE_METHODS:
                numbers[f"{name}_{place}_{method}"] = mean_value(rows, method=method, level=level)
    return numbers


def mean_value(rows: pd.DataFrame, **columns: Any) -> float:
    """Mean value of the rows with these values in these columns."""
    return float(select(rows, columns)["value"].mean())


# -------------------------------------------- interventions at random, to check the theorem


def same_graph(model: SCM, target: str, rng: np.random.Generator) -> SCM:
    """New coefficients and noises at random for everything but the target; no arrow changes."""
    others = [name for name in model.assignments if name != target]
    return model.intervene(**{n: _random_assignment(model.parents(n), rng) for n in others})


def any_graph(model: SCM, target: str, rng: np.random.Generator) -> SCM:
    """A random order in which the target is after its causes; all depend on what is before them."""
    others = [name for name in model.assignments if name != target]
    while True:
        order = list(rng.permutation([*others, target]))
        if order.index(target) > max(map(order.index, model.parents(target))):
            break
    return model.intervene(**{n: _random_assignment(order[: order.index(n)], rng) for n in others})


def _random_assignment(parents: Sequence[str], rng: np.random.Generator) -> Linear:
    return Linear({parent: rng.normal() for parent in parents}, Normal(0, rng.uniform(0.5, 2)))


def largest_change(covariances: Sequence[pd.DataFrame], target: str, S: Sequence[str]) -> float:
    """By how much b_S and v_S of the population's regression on S differ between models."""
    fits = [population_regression(covariance, target, S) for covariance in covariances]
    return max(np.ptp([[*b, v] for b, v in fits], axis=0))
