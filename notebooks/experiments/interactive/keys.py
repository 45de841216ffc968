"""What policies of the coloured keys do in every state: the table of the task, and log-policies."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from minigrid.core.actions import Actions
from minigrid.core.world_object import Door, Key

from experiments.figures import label
from experiments.keys import Keys
from ipo.networks import Weights
from ipo.worlds.colored_keys import ColoredKeysEnv
from ipo.worlds.minigrid_tables import state_of
from ipo.worlds.tabular import TabularTask

NUM_RUNS = 3  # the first ones of every arm, whatever came out
LAYOUTS = (0, 1, 2)  # seeds of MiniGrid's reset, likewise
STEPS = 1000  # of a log-probability within one nat, so that 16 bits hold it


def policies_in_states(
    task: Keys, saved: Mapping[str, Sequence[Weights]], colors: Sequence[str]
) -> dict[str, Any]:
    """The data: what every action does in every state, and how likely policies take it.

    Args:
        task: the tabulated task; states and observations count alike in all colours.
        saved: weights of every player, by arm.
        colors: of key and door.
    """
    table = task.tasks[colors[0]]
    starts, scenes = _scenes(table, colors[0])
    return {
        "colors": list(colors),
        "actions": [action.name for action in Actions],
        "layouts": starts,
        "next": np.where(table.goal, -1, table.next_state).tolist(),
        "goal_reward": table.goal_reward.round(6).tolist(),
        "start": table.start.round(6).tolist(),
        "observation": table.observation.tolist(),
        "scenes": [scenes.get(state) for state in range(len(table.start))],
        "steps": STEPS,
        "policies": {
            f"{label(arm)}, run {run}": packed
            for arm, players in saved.items()
            for run, packed in enumerate(_packed_runs(task, players, colors))
        },
    }


def _packed_runs(
    task: Keys, players: Sequence[Weights], colors: Sequence[str]
) -> Iterator[tuple[str, ...]]:
    """Of every run, a text for each colour."""
    everywhere = task.logits_in_all_colors(players)[:NUM_RUNS]
    logits = [task.seen_in(color, everywhere) for color in colors]
    by_color = [[_packed(run) for run in of_color.log_softmax(-1).numpy()] for of_color in logits]
    return zip(*by_color, strict=True)


def _packed(log_policy: np.ndarray) -> str:
    """Log-probabilities ``[K, A]`` as 16-bit integers, for JavaScript."""
    steps = (log_policy * STEPS).round().clip(-(2**15), 0)
    return base64.b64encode(steps.astype("<i2").tobytes()).decode()


def _scenes(table: TabularTask, color: str) -> tuple[list[int], dict[int, list[int]]]:
    """The states in which layouts begin; what there is to see in every state reached from them."""
    env = ColoredKeysEnv(5, color)
    starts, scenes = [], {}
    for seed in LAYOUTS:
        env.reset(seed=seed)
        starts.append(state_of(table, env))
        for state, path in _paths(table, starts[-1]):
            if state not in scenes:
                env.reset(seed=seed)
                for action in path:
                    env.step(action)
                scenes[state] = _scene(env)
    return starts, scenes


def _paths(table: TabularTask, start: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Every state that can be reached, and a shortest sequence of actions that leads there."""
    found = {start: ()}
    queue = [start]
    for state in queue:  # which grows on the way
        yield state, found[state]
        for action, after in enumerate(table.next_state[state].tolist()):
            if after not in found:
                found[after] = (*found[state], action)
                queue.append(after)


def _scene(env: ColoredKeysEnv) -> list[int]:
    """Column, row and direction of the agent; of the key, -1 in hand; of the door, and its state.

    The door is open (0), closed (1) or locked (2).
    """
    places = {
        type(thing): divmod(place, env.width)[::-1]
        for place, thing in enumerate(env.grid.grid)
        if thing is not None
    }
    door = env.grid.get(*places[Door])
    key = places.get(Key, (-1, -1))
    door_state = 2 * door.is_locked or 1 - door.is_open
    return [*map(int, (*env.agent_pos, env.agent_dir, *key, *places[Door], door_state))]


def picture(data: Mapping[str, Any]) -> Figure:
    """What the script shows first: the first layout, colour and policy."""
    env = ColoredKeysEnv(5, data["colors"][0], render_mode="rgb_array", highlight=False)
    env.reset(seed=LAYOUTS[0])
    name, packed = next(iter(data["policies"].items()))
    log_policy = np.frombuffer(base64.b64decode(packed[0]), "<i2").reshape(-1, len(Actions))
    seen = data["observation"][data["layouts"][0]]
    fig, (left, right) = plt.subplots(1, 2, figsize=(7, 3))
    left.imshow(env.render())
    left.axis("off")
    right.barh(data["actions"], np.exp(log_policy[seen] / STEPS), color="0.6")
    right.invert_yaxis()
    right.set(title=name, xlabel="probability", xlim=(0, 1))
    return fig
