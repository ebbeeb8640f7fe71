"""The controls of the page, which turn changes by users into requests to the session."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any

import viser
from viser._messages import RunJavascriptMessage

from legged_torque.viewer.drawing import Ground
from legged_torque.viewer.session import AS_LOADED, FASTEST, SLOWEST, Command, Session

PUSHES = {"from behind": 0.0, "from the right": 90.0, "from the front": 180.0, "from the left": -90.0}
"""Directions of pushes from the robot's heading to its left [degrees]."""
STEP = 0.05  # of the sliders of commands [m/s, rad/s] and weights
KEYS = '<div class="lt-keys">or hold W A S D, arrows, or a gamepad\'s sticks</div>'
COMMANDS = {"x [m/s]": "forward", "y [m/s]": "to the left", "yaw [rad/s]": "turning to the left"}
VIEW = {
    "follow": ("camera follows", True, "keeps the followed robot in view"),
    "others": ("all worlds", True, "draw the other worlds too"),
    "contacts": ("contacts", True, "points and forces, 1 m for 500 N"),
    "collision": ("collision geoms", False, "what touches the ground in the simulator"),
    "ghost": ("ghost", False, "where the commands of the last second lead"),
    "scan": ("height scan", True, "where the ground is measured"),
}
"""What is drawn, by name: label, whether it is at first, hint."""


class Controls:
    """The panel with all controls.

    Attributes:
        status: Text above the controls.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, ground: Ground | None) -> None:
        """Build the panel; a ground of None is a plane."""
        self._gui, self._session = gui, session
        self._shown: list[tuple[Any, str, Callable[[], Any]]] = []  # controls, attributes of theirs, and their values
        self.status = gui.add_html("")
        with gui.add_folder("Command"):
            self._add_command()
        with gui.add_folder("Time"):
            self._bind(gui.add_checkbox("pause", False), lambda: session.is_paused, session.set_paused)
            speed = gui.add_slider("speed [x]", SLOWEST, FASTEST, 0.1, FASTEST, hint="1 is real time")
            self._bind(speed, lambda: session.pacer.speed, session.set_speed)
            reset = gui.add_button("Reset", icon=viser.Icon.ROTATE, hint="a new episode in every world")
            reset.on_click(lambda event: session.reset())
        with gui.add_folder("Push"):
            direction = gui.add_dropdown("push", tuple(PUSHES), hint="in the robot's frame")
            hint = "added to the trunk's velocity at once"
            strength = gui.add_slider("strength [m/s]", 0.1, 2.0, 0.1, 0.8, hint=hint)
            push = gui.add_button("Push", icon=viser.Icon.ARROW_BIG_RIGHT)
            push.on_click(lambda event: session.push(math.radians(PUSHES[direction.value]), strength.value))
        with gui.add_folder("Run"):
            self._add_run()
        if session.mixing:
            with gui.add_folder("Mixing weights"):
                automatic = gui.add_checkbox("as in training", True, hint="the weights at this point of the training")
                sliders = [gui.add_slider(name.replace("_", " "), 0.0, 1.0, STEP, 0.0) for name in session.mixing]
                values = (lambda: list(session.mixing.values()), automatic, lambda: session.chosen_mixing is None)
                self._bind_sliders(sliders, *values, session.set_mixing)
        if ground:
            with gui.add_folder("Tile"):
                self._add_tile(ground)
        with gui.add_folder("View"):
            self._add_view(is_rough=ground is not None)

    def _bind(self, control: viser.GuiInputHandle, value: Callable[[], Any], request: Callable[[Any], None]) -> None:
        """Show a value of the session in a control, and request what users choose."""
        self._shown.append((control, "value", value))
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
        field = gui.add_vector3("steering", (0.0, 0.0, 0.0), visible=False)  # set by held keys and a gamepad

        @field.on_update
        async def changed(event: viser.GuiEvent) -> None:  # viser calls coroutines in the order of the changes
            if all(abs(share) <= 1.0 for share in field.value):
                steer(field.value)

        script = files("legged_torque.viewer").joinpath("page.js").read_text().replace("FIELD", field._impl.uuid)
        gui._websock_interface.queue_message(RunJavascriptMessage(script))  # as viser itself does for Plotly

    def _add_run(self) -> None:
        """Add checkpoints and perturbations."""
        gui, session = self._gui, self._session
        self._add_checkpoint("checkpoint", session)
        newest = gui.add_checkbox("follow training", False, hint="load each new checkpoint as soon as it is saved")
        self._bind(newest, lambda: session.follows_newest, session.follow_newest)
        if session.companion:
            self._add_checkpoint("companion", session.companion)
        hint = "random parameters, pushes and noise; rebuilds the worlds"
        perturbation = gui.add_dropdown("perturbation", (AS_LOADED, *session.task.cfg.perturbations()), hint=hint)
        self._bind(perturbation, lambda: session.perturbation, session.set_perturbation)

    def _add_checkpoint(self, label: str, session: Session) -> None:
        """Add the choice of a session's checkpoint."""
        control = self._gui.add_dropdown(label, (str(session.checkpoint),), hint="iterations of the training")

        def options() -> tuple[str, ...]:
            return tuple(map(str, sorted({*session.checkpoints, session.checkpoint})))

        def choose(value: str) -> None:
            session.follow_newest(False)
            session.load_checkpoint(int(value))

        self._shown.append((control, "options", options))
        self._bind(control, lambda: str(session.checkpoint), choose)

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

    def _add_view(self, is_rough: bool) -> None:
        """Add the followed world and what is drawn."""
        gui, session, num_envs = self._gui, self._session, self._session.task.num_envs
        if num_envs > 1:
            world = gui.add_dropdown("world", tuple(map(str, range(num_envs))), hint="for camera and plots")
            self._bind(world, lambda: str(session.world), lambda value: session.follow_world(int(value)))
        is_needed = {"others": num_envs > 1, "scan": is_rough}
        self._boxes = {
            name: gui.add_checkbox(label, is_on, hint=hint, visible=is_needed.get(name, True))
            for name, (label, is_on, hint) in VIEW.items()
        }

    def drawn(self) -> set[str]:
        """Return the names in :data:`VIEW` of what users want to see."""
        return {name for name, box in self._boxes.items() if box.value}

    def update(self) -> None:
        """Show the session's values, unless a choice has not been carried out yet."""
        if any(session and session.requests for session in (self._session, self._session.companion)):
            return
        for control, attribute, value in self._shown:
            now = value()
            if isinstance(control, viser.GuiSliderHandle):
                now = round(min(max(now, control.min), control.max), 2)
            if getattr(control, attribute) != now:  # each change is a message to the browsers
                setattr(control, attribute, now)
