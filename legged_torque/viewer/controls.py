"""The controls of the page, which turn changes by users into requests to the session."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import viser

from legged_torque.viewer.ground import Ground
from legged_torque.viewer.scene import View
from legged_torque.viewer.session import FASTEST, SLOWEST, Command, Session
from legged_torque.viewer.steering import add_steering

PUSHES = {"from behind": 0.0, "from the right": 90.0, "from the front": 180.0, "from the left": -90.0}
"""Directions of pushes from the robot's heading to its left [degrees]."""
STEP = 0.05  # of the sliders of commands [m/s, rad/s] and weights
KEYS = '<div style="font-size:12px;padding:0 12px">or hold W A S D, arrows, or a gamepad\'s sticks</div>'
COMMANDS = {"x [m/s]": "forward", "y [m/s]": "to the left", "yaw [rad/s]": "turning to the left"}
VIEW = {
    "follow": ("camera follows", "keeps the followed robot in view"),
    "others": ("all worlds", "draw the other worlds too"),
    "contacts": ("contacts", "points and forces, 1 m for 500 N"),
    "collision": ("collision geoms", "what touches the ground in the simulator"),
    "ghost": ("ghost", "where the commands of the last second lead"),
    "scan": ("height scan", "where the ground is measured"),
}
"""Labels and hints of the fields of :class:`~legged_torque.viewer.scene.View`."""


class Controls:
    """The panel with all controls.

    Attributes:
        status: Text above the controls.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, view: View, ground: Ground | None) -> None:
        """Build the panel; a ground of None is a plane."""
        self._gui, self._session = gui, session
        self._shown: list[tuple[viser.GuiInputHandle, Callable[[], Any]]] = []  # controls and their values
        self._checkpoints: list[tuple[viser.GuiDropdownHandle, Session]] = []
        self.status = gui.add_html("")
        with gui.add_folder("Command"):
            self._add_command()
        with gui.add_folder("Time"):
            self._add_time()
        with gui.add_folder("Push"):
            self._add_push()
        with gui.add_folder("Run"):
            self._add_run()
        if session.mixing:
            with gui.add_folder("Mixing weights"):
                self._add_mixing()
        if ground:
            with gui.add_folder("Tile"):
                self._add_tile(ground)
        with gui.add_folder("View"):
            self._add_view(view, is_rough=ground is not None)

    def _bind(self, control: viser.GuiInputHandle, value: Callable[[], Any], request: Callable[[Any], None]) -> None:
        """Show a value of the session in a control, and request what users choose."""
        self._shown.append((control, value))
        control.on_update(lambda event: request(control.value) if event.client else None)  # a user has changed it

    def _bind_sliders(
        self,
        sliders: Sequence[viser.GuiInputHandle],
        values: Callable[[], Sequence[float]],
        automatic: viser.GuiInputHandle,
        is_automatic: Callable[[], bool],
        request: Callable[[Any], None],
    ) -> None:
        """Request the values of sliders, or None when a checkbox is ticked."""

        def choose(value: object) -> None:
            request(tuple(slider.value for slider in sliders))

        self._bind(automatic, is_automatic, lambda value: request(None) if value else choose(value))
        for place, slider in enumerate(sliders):
            self._bind(slider, functools.partial(lambda place: values()[place], place), choose)

    def _add_command(self) -> None:
        """Add the commanded velocities. Moving a slider ends random commands."""
        gui, session, ranges = self._gui, self._session, self._session.task.cfg.commands.ranges
        random = gui.add_checkbox("random", True, hint="drawn as in training, for each world")
        limits = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
        sliders = [
            gui.add_slider(label, low, max(high, low + STEP), STEP, low, hint=hint)
            for (label, hint), (low, high) in zip(COMMANDS.items(), limits, strict=True)
        ]

        def command() -> Sequence[float]:
            drawn = session.snapshot.commands[session.world].tolist() if session.snapshot else (0.0, 0.0, 0.0)
            return session.command or drawn

        def steer(shares: Command) -> None:
            pairs = zip(sliders, shares, strict=True)
            x, y, yaw = (share * (slider.max if share > 0.0 else -slider.min) for slider, share in pairs)
            session.set_command((x, y, yaw))

        self._bind_sliders(sliders, command, random, lambda: session.command is None, session.set_command)
        gui.add_html(KEYS)
        gui.add_button("Stand still", icon=viser.Icon.HAND_STOP).on_click(lambda event: steer((0.0, 0.0, 0.0)))
        add_steering(gui, steer)

    def _add_time(self) -> None:
        """Add pause, speed and reset."""
        gui, session = self._gui, self._session
        self._bind(gui.add_checkbox("pause", False), lambda: session.is_paused, session.set_paused)
        speed = gui.add_slider("speed [x]", SLOWEST, FASTEST, 0.1, FASTEST, hint="1 is real time")
        self._bind(speed, lambda: session.speed, session.set_speed)
        reset = gui.add_button("Reset", icon=viser.Icon.ROTATE, hint="a new episode in every world")
        reset.on_click(lambda event: session.reset())

    def _add_push(self) -> None:
        """Add pushes."""
        direction = self._gui.add_dropdown("push", tuple(PUSHES), hint="in the robot's frame")
        hint = "added to the trunk's velocity at once"
        speed = self._gui.add_slider("strength [m/s]", 0.1, 2.0, 0.1, 0.8, hint=hint)
        push = self._gui.add_button("Push", icon=viser.Icon.ARROW_BIG_RIGHT)
        push.on_click(lambda event: self._session.push(math.radians(PUSHES[direction.value]), speed.value))

    def _add_run(self) -> None:
        """Add checkpoints and perturbations."""
        gui, session = self._gui, self._session
        self._add_checkpoint("checkpoint", session)
        newest = gui.add_checkbox("follow training", False, hint="load each new checkpoint as soon as it is saved")
        self._bind(newest, lambda: session.follows_newest, session.follow_newest)
        if session.companion:
            self._add_checkpoint("companion", session.companion)
        hint = "random parameters, pushes and noise; rebuilds the worlds"
        perturbation = gui.add_dropdown("perturbation", tuple(session.perturbations()), hint=hint)
        self._bind(perturbation, lambda: session.perturbation, session.set_perturbation)

    def _add_checkpoint(self, label: str, session: Session) -> None:
        """Add the choice of a session's checkpoint."""
        control = self._gui.add_dropdown(label, (str(session.checkpoint),), hint="iterations of the training")
        self._checkpoints.append((control, session))

        def choose(value: str) -> None:
            session.follow_newest(False)
            session.load_checkpoint(int(value))

        self._bind(control, lambda: str(session.checkpoint), choose)

    def _add_mixing(self) -> None:
        """Add the weights of action terms."""
        gui, session = self._gui, self._session
        automatic = gui.add_checkbox("as in training", True, hint="the weights at this point of the training")
        sliders = [gui.add_slider(name.replace("_", " "), 0.0, 1.0, STEP, 0.0) for name in session.mixing]
        values = (lambda: list(session.mixing.values()), automatic, lambda: not session.is_mixing_set)
        self._bind_sliders(sliders, *values, session.set_mixing)

    def _add_tile(self, ground: Ground) -> None:
        """Add the tile of the followed robot."""
        gui, session, kinds, last = self._gui, self._session, ground.layout.kinds(), ground.layout.num_rows - 1
        names = tuple(dict.fromkeys(kinds))
        kind = gui.add_dropdown("kind", names, hint="moves the followed robot onto such a tile")
        level = gui.add_slider("level", 0, max(last, 1), 1, 0, hint="the first is the easiest", disabled=last == 0)

        def tile() -> tuple[int, int]:
            return (session.snapshot and session.snapshot.tile) or (0, 0)

        def move(value: object) -> None:
            session.set_tile(level.value, kinds.index(kind.value))

        self._bind(kind, lambda: kinds[tile()[1]], move)
        self._bind(level, lambda: tile()[0], move)

    def _add_view(self, view: View, is_rough: bool) -> None:
        """Add the followed world and what is drawn."""
        session, num_envs = self._session, self._session.task.num_envs
        if num_envs > 1:
            world = self._gui.add_dropdown("world", tuple(map(str, range(num_envs))), hint="for camera and plots")
            self._bind(world, lambda: str(session.world), lambda value: session.follow_world(int(value)))
        for name, (label, hint) in VIEW.items():
            if {"others": num_envs > 1, "scan": is_rough}.get(name, True):
                box = self._gui.add_checkbox(label, getattr(view, name), hint=hint)
                box.on_update(lambda event, name=name: setattr(view, name, event.target.value))

    def update(self) -> None:
        """Show the session's values, unless a choice has not been carried out yet."""
        for dropdown, session in self._checkpoints:
            names = tuple(map(str, sorted({*session.checkpoints, session.checkpoint})))
            if names != tuple(dropdown.options):
                dropdown.options = names
        if any(session.requests for _, session in self._checkpoints):
            return
        for control, value in self._shown:
            now = value()
            if isinstance(control, viser.GuiSliderHandle):
                now = round(min(max(now, control.min), control.max), 2)
            if control.value != now:  # each change is a message to the browsers
                control.value = now
