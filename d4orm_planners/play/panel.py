"""The controls of the page: everything that it can ask for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import viser

from d4orm_env.core.errors import describe
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import list_scenarios
from d4orm_env.scenarios.problem_files import scenario_text
from d4orm_env.scenarios.problems import SCENARIOS
from d4orm_env.scenarios.schema import parse
from d4orm_planners.base.display import markdown_text
from d4orm_planners.play import edits
from d4orm_planners.play.origin_check import LARGEST_UPLOAD
from d4orm_planners.play.session import Session
from d4orm_planners.play.viewport import Frame

if TYPE_CHECKING:
    from d4orm_planners.play.playground import View

POLICIES = {
    "d4orm-c2f": "D4orm-C2F",
    "orca": "ORCA",
    "ppo": "PPO",
    "sac": "SAC",
    "go-to-goal": "straight",
    "hybrid": "open loop: hybrid",
    "mapf": "open loop: path finding",
}
"""Policies that the page offers, and what it calls them."""

MODELS = ("scenario's own", "holonomic2d", "velocity2d", "differential_drive", "unicycle", "car", "holonomic3d")
OWN_MODEL = MODELS[0]


class Levels(NamedTuple):
    """Levels of one disturbance that a slider offers."""

    label: str  #: Its name on the page, with its unit
    low: float  #: Least level
    high: float  #: Greatest level
    step: float  #: Between levels
    off: float  #: The level at which nothing goes wrong


SLIDERS = {
    "control_noise": Levels("Noise on controls", 0.0, 1.0, 0.02, 0.0),
    "correlated_noise": Levels("Slow noise on controls", 0.0, 1.0, 0.02, 0.0),
    "bias": Levels("Bias of controls", 0.0, 0.5, 0.01, 0.0),
    "gain": Levels("Gain of controls off by", 0.0, 0.8, 0.02, 0.0),
    "quantisation": Levels("Controls rounded to", 0.0, 1.0, 0.05, 0.0),
    "delay": Levels("Controls late [steps]", 0, 10, 1, 0),
    "dropout": Levels("Controls lost", 0.0, 0.95, 0.05, 0.0),
    "state_noise": Levels("Noise on positions seen [m]", 0.0, 0.2, 0.005, 0.0),
    "state_delay": Levels("States seen late [steps]", 0, 10, 1, 0),
    "occlusion": Levels("Sight [m]", 0.2, 10.0, 0.2, 10.0),
    "push": Levels("Pushes per robot [1/s]", 0.0, 2.0, 0.05, 0.0),
    "stall": Levels("Robots that stall", 0.0, 1.0, 0.05, 0.0),
    "intruder": Levels("Intruders", 0, 8, 1, 0),
    "drag": Levels("Drag [1/s]", 0.0, 2.0, 0.05, 0.0),
    "limit_mismatch": Levels("Limits are truly times", 0.3, 1.0, 0.05, 1.0),
}
"""Sliders for what goes wrong, by name and attribute, see :mod:`~d4orm_env.disturbances.disturbance_registry`."""

STATUS_EVERY = 0.2
PUSH = 0.8  #: Velocity that a push gives a robot [m/s]


class Panel:
    """Buttons, sliders and menus of a page."""

    def __init__(self, server: viser.ViserServer, session: Session, view: View) -> None:
        self._gui, self._session, self._view = server.gui, session, view
        self._random = np.random.default_rng(0)
        self._saving = threading.Lock()
        self._status_at = 0.0
        self._text, self._refused = "", 0
        self._status = self._gui.add_markdown("")
        with self._gui.add_folder("Clock"):
            self._add_clock()
        with self._gui.add_folder("Who drives", expand_by_default=False):
            self._add_policies()
        with self._gui.add_folder("What goes wrong", expand_by_default=False):
            self._add_disturbances()
        with self._gui.add_folder("Change the scene"):
            self._add_edits()
        with self._gui.add_folder("Another scene", expand_by_default=False):
            self._add_scenes()
        with self._gui.add_folder("Show", expand_by_default=False):
            for name in view.shown:
                self._add_choice(name)
        with self._gui.add_folder("Files", expand_by_default=False):
            self._add_files()

    def update(self) -> None:
        now = time.perf_counter()
        if now - self._status_at < STATUS_EVERY:
            return
        self._status_at = now
        frames = self._session.frames
        text = status_text(frames)
        if text != self._text:
            self._text = self._status.content = text
        status = frames[0].status
        # The controls then say what is, unless a change waits that they show already.
        if status.refused != self._refused and not self._session.busy:
            self._refused, self.paused.value = status.refused, status.state == "paused"
            for name, slider in self._sliders.items():
                slider.value = self._session.levels.get(name, SLIDERS[name].off)
            for name, box in self._drivers.items():
                box.value = name in self._session.policies

    def _add_clock(self) -> None:
        self.paused: Any = self._gui.add_checkbox("Paused", False)
        self.paused.on_update(lambda event: self._session.pause(self.paused.value) if event.client else None)
        step, reset = self._gui.add_button("Step"), self._gui.add_button("Reset")

        def one_step(_: object) -> None:
            self.paused.value = True
            self._session.step()

        step.on_click(one_step)
        reset.on_click(lambda _: self._session.reset())
        speed = self._gui.add_slider("Speed", 0.1, 8.0, 0.1, 1.0)
        speed.on_update(lambda _: self._session.set_speed(speed.value))
        lifelong = self._gui.add_checkbox("Lifelong goals", False)
        lifelong.on_update(lambda _: self._session.set_lifelong(lifelong.value))

    def _add_policies(self) -> None:
        self._gui.add_markdown("Several drive side by side. To begin with the same start: Reset.")
        offered = dict.fromkeys((*self._session.policies, *POLICIES))
        self._drivers: dict[str, Any] = {
            name: self._gui.add_checkbox(POLICIES.get(name, name), name in self._session.policies) for name in offered
        }
        for box in self._drivers.values():
            box.on_update(self._choose)
        horizon = self._gui.add_slider("Look ahead", 5, 50, 1, 20, hint="Steps that D4orm-C2F predicts.")
        horizon.on_update(lambda _: self._session.set_horizon(int(horizon.value)))

    def _choose(self, event: viser.GuiEvent[viser.GuiCheckboxHandle]) -> None:
        if event.client is not None:  # a viewer's, not this program's
            self._session.choose(*(name for name, box in self._drivers.items() if box.value))

    def _add_disturbances(self) -> None:
        self._gui.add_markdown("From the next step on, the same for all that drive.")
        self._sliders: dict[str, Any] = {name: self._gui.add_slider(*levels) for name, levels in SLIDERS.items()}

        def disturb() -> None:
            chosen = {name: slider.value for name, slider in self._sliders.items()}
            self._session.disturb({name: level for name, level in chosen.items() if level != SLIDERS[name].off})

        def turn(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client is not None:  # a viewer's, not this program's
                disturb()

        def clear(_: object) -> None:
            for name, slider in self._sliders.items():
                slider.value = SLIDERS[name].off
            disturb()

        for slider in self._sliders.values():
            slider.on_update(turn)
        self._gui.add_button("Nothing").on_click(clear)

    def _add_edits(self) -> None:
        self._gui.add_markdown("Drag robots, goals and obstacles; drag a robot with Shift to push it.")
        changes: dict[str, edits.Edit] = {
            "Add robot": partial(edits.add_robot, random=self._random),
            "Remove robot": edits.remove_robot,
            "Add disc": partial(edits.add_obstacle, kind="disc", random=self._random),
            "Add box": partial(edits.add_obstacle, kind="box", random=self._random),
            "Remove obstacle": edits.remove_obstacle,
        }
        for name, change in changes.items():
            self._gui.add_button(name).on_click(partial(lambda change, _: self._session.edit(change), change))
        self._gui.add_button("Push a robot").on_click(lambda _: self._push_farthest())

    def _push_farthest(self) -> None:
        """Push the robot that is farthest from its goal, any way."""
        direction = self._random.normal(size=self._session.frame.problem.dimension)
        self._session.push(None, PUSH * direction / np.linalg.norm(direction))

    def _add_scenes(self) -> None:
        names = tuple(name for name in list_scenarios() if name != "map")
        scenario = self._gui.add_dropdown("Scenario", names, initial_value="circle")
        robots = self._gui.add_slider("Robots", 1, 64, 1, 16)
        model = self._gui.add_dropdown("Model", MODELS)
        seed = self._gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)

        def load(_: object) -> None:
            name, number, first = scenario.value, int(robots.value), int(seed.value)
            chosen = None if model.value == OWN_MODEL else model.value
            # By name only, as in scenario files: nothing that a page says is imported.
            self._session.load(lambda: SCENARIOS.look_up(name).problem(number, first, model=chosen), first)

        self._gui.add_button("Begin").on_click(load)

    def _add_choice(self, name: str) -> None:
        box = self._gui.add_checkbox(name.capitalize(), self._view.shown[name])

        def choose(_: object) -> None:
            self._view.shown[name] = box.value
            self._gui.configure_theme(dark_mode=self._view.shown["dark"], **THEME)

        box.on_update(choose)

    def _add_files(self) -> None:
        scene, replay = self._gui.add_button("Save scene"), self._gui.add_button("Save replay")
        load = self._gui.add_upload_button("Load scene", mime_type=".yaml,.yml")

        scene.on_click(self._saved("scene.yaml", lambda: scenario_text(edits.at_rest(self._session.scene))))
        replay.on_click(self._saved("replay.html", lambda: self._session.replay().html))
        load.on_upload(lambda _: self._session.load(partial(read_scene, load.value.content)))

    def _saved(self, name: str, text: Callable[[], str]) -> Callable[[viser.GuiEvent[viser.GuiButtonHandle]], None]:
        """Return a handler that sends a file: one at a time, as a long replay takes seconds to write."""

        def save(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if not self._saving.acquire(blocking=False):
                self._session.refuse(f"a file is being written; ask for {name} when that is done")
                return
            try:
                content = text().encode()
                if event.client is not None:  # it is still there
                    event.client.send_file_download(name, content, save_immediately=True)
            except Exception as error:
                self._session.refuse(f"{name} cannot be written: {describe(error)}")
            finally:
                self._saving.release()

        return save


THEME: dict[str, Any] = {"show_logo": False, "show_share_button": False, "control_width": "medium"}


def status_text(frames: Sequence[Frame]) -> str:
    first, status = frames[0], frames[0].status
    team = first.problem.num_robots
    who = ", ".join(frame.policy for frame in frames)
    lines = [
        f"**{markdown_text(first.problem.name)}, {team} robots, {markdown_text(who)}: {status.state}**",
        f"time {status.time:.1f} s",
    ]
    for frame in frames:
        contacts = int(frame.collided.sum())
        touching = f", **{contacts} in contact**" if contacts else ""
        arrived = f"arrived {int(frame.arrived.sum())} of {team}"
        loop, planning = f"{1e3 * frame.loop:.0f} ms", f"{frame.replanned:.2f} s"
        if len(frames) == 1:
            lines += [
                arrived,
                f"closest approach {100 * frame.closest:.1f} cm{touching}",
                f"control loop {loop}, last replanning {planning}",
            ]
        else:
            name = markdown_text(frame.policy)
            lines.append(f"**{name}**: {arrived}, {100 * frame.closest:.1f} cm{touching}, {loop}, {planning}")
    if status.message:
        lines.append(f"**{markdown_text(status.message)}**")
    return "  \n".join(lines)


def read_scene(content: bytes) -> Problem:
    """A scenario file that a page sent. Raises ValueError if it is too large, not text, or no scenario."""
    if len(content) > LARGEST_UPLOAD:
        raise ValueError(f"the file has {len(content)} bytes; a scene has at most {LARGEST_UPLOAD}")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError("the file is not UTF-8 text; load a scenario's YAML file") from None
    data = parse_yaml(text)
    _check_size(data if isinstance(data, dict) else {})
    problem = parse(data)
    _check_size({"num_robots": problem.num_robots, "num_obstacles": problem.world.num_obstacles})
    return problem


def _check_size(scene: Mapping[str, object]) -> None:
    """Refuse more than a page can show, before it is made where a file says so."""
    for name, most in {"num_robots": edits.MOST_ROBOTS, "num_obstacles": edits.MOST_OBSTACLES}.items():
        number = scene.get(name)
        if isinstance(number, int) and number > most:
            raise ValueError(f"the scene's {name} is {number}; at most {most} can be played with")
