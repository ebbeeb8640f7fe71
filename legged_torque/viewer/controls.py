"""The controls of the page: what a click asks the session for."""

from __future__ import annotations

import math

import viser

from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import FASTEST, SLOWEST, Session
from legged_torque.viewer.state import State

DIRECTIONS = {"from behind": 0.0, "from the right": 90.0, "from the front": 180.0, "from the left": -90.0}
"""Where a push comes from, and its direction from the robot's front to its left [degrees]."""


def by_user(event: viser.GuiEvent) -> bool:
    """Return whether a value was changed in a browser, not by this program."""
    return event.client is not None


class Controls:
    """The panel with everything that can be changed. Its callbacks only leave requests with the session."""

    def __init__(self, server: viser.ViserServer, session: Session, scene: Scene) -> None:
        """Build the panel.

        Args:
            server: The page.
            session: What is watched.
            scene: Its drawing.
        """
        self._gui, self._session, self._scene = server.gui, session, scene
        self._loaded: tuple[int, str, int] | None = None
        self.status = self._gui.add_html("")
        self._add_command()
        self._add_time()
        self._add_push()
        self._add_run()
        self._add_mixing()
        self._add_view()

    def _add_command(self) -> None:
        """Add the commanded velocities; moving a slider takes over from chance."""
        gui, ranges = self._gui, self._session.task.cfg.commands.ranges
        limits = {"x [m/s]": ranges.lin_vel_x, "y [m/s]": ranges.lin_vel_y, "yaw [rad/s]": ranges.ang_vel_yaw}
        hints = ("forward", "to the left", "turning to the left")
        with gui.add_folder("Command"):
            self._random = gui.add_checkbox("random", True, hint="drawn as in training: for each world, now and then")
            self.sliders = []
            for (label, (low, high)), hint in zip(limits.items(), hints, strict=True):
                start = min(max(0.0, low), high)
                self.sliders.append(gui.add_slider(label, low, max(high, low + 0.05), 0.05, start, hint=hint))
            stand = gui.add_button("Stand still", icon="hand-stop")

        def send(event: viser.GuiEvent) -> None:
            if by_user(event):
                self._random.value = False
                self._session.set_command(tuple(slider.value for slider in self.sliders))

        def draw(event: viser.GuiEvent) -> None:
            if by_user(event):
                chosen = tuple(slider.value for slider in self.sliders)
                self._session.set_command(None if self._random.value else chosen)

        def stop(event: viser.GuiEvent) -> None:
            for slider in self.sliders:
                slider.value = 0.0
            send(event)

        for slider in self.sliders:
            slider.on_update(send)
        self._random.on_update(draw)
        stand.on_click(stop)

    def _add_time(self) -> None:
        """Add pause, reset and speed."""
        gui, session = self._gui, self._session
        with gui.add_folder("Time"):
            self._pause = gui.add_checkbox("pause", False)
            speed = gui.add_slider("speed [x]", SLOWEST, FASTEST, 0.1, FASTEST, hint="1 is real time")
            reset = gui.add_button("Reset", icon="rotate", hint="a new episode in every world")
        self._pause.on_update(lambda event: by_user(event) and session.set_paused(self._pause.value))
        speed.on_update(lambda event: by_user(event) and session.set_speed(speed.value))
        reset.on_click(lambda event: session.reset())

    def _add_push(self) -> None:
        """Add what pushes the robots."""
        gui = self._gui
        with gui.add_folder("Push"):
            direction = gui.add_dropdown("push", tuple(DIRECTIONS))
            strength = gui.add_slider(
                "strength [m/s]", 0.1, 2.0, 0.1, 0.8, hint="added to the trunk's velocity at once"
            )
            push = gui.add_button("Push", icon="arrow-big-right")
        push.on_click(lambda event: self._session.push(math.radians(DIRECTIONS[direction.value]), strength.value))

    def _add_run(self) -> None:
        """Add checkpoints and perturbations."""
        gui, session, state = self._gui, self._session, self._session.state
        with gui.add_folder("Run"):
            names = tuple(map(str, state.checkpoints)) or (str(state.checkpoint),)
            self.checkpoints = gui.add_dropdown("checkpoint", names, initial_value=str(state.checkpoint))
            newest = gui.add_checkbox("follow training", False, hint="load each new checkpoint as soon as it is saved")
            perturbations = session.perturbations()
            self.perturbation = gui.add_dropdown(
                "perturbation", tuple(perturbations), hint="random parameters, pushes and noise; rebuilds the worlds"
            )

        def load(event: viser.GuiEvent) -> None:
            if by_user(event):
                newest.value = False
                session.follow_newest(False)
                session.load_checkpoint(int(self.checkpoints.value))

        self.checkpoints.on_update(load)
        newest.on_update(lambda event: by_user(event) and session.follow_newest(newest.value))
        self.perturbation.on_update(lambda event: by_user(event) and session.set_perturbation(self.perturbation.value))

    def _add_mixing(self) -> None:
        """Add the weights of PD control and torque actions, for a task that has them."""
        gui, mixing = self._gui, self._session.state.mixing
        if mixing is None:
            return
        with gui.add_folder("Mixing weights"):
            self._trained = gui.add_checkbox("as in training", True, hint="those that the checkpoint was trained with")
            self._weights = [
                gui.add_slider(label, 0.0, 1.0, 0.05, min(max(value, 0.0), 1.0))
                for label, value in zip(("PD control", "torque actions"), mixing, strict=True)
            ]

        def send(event: viser.GuiEvent) -> None:
            if by_user(event):
                self._trained.value = False
                self._session.set_mixing(tuple(weight.value for weight in self._weights))

        def restore(event: viser.GuiEvent) -> None:
            if by_user(event):
                chosen = tuple(weight.value for weight in self._weights)
                self._session.set_mixing(None if self._trained.value else chosen)

        for weight in self._weights:
            weight.on_update(send)
        self._trained.on_update(restore)

    def _add_view(self) -> None:
        """Add what is looked at; drawing needs no step, so that these act at once."""
        gui, scene, num_envs = self._gui, self._scene, self._session.task.num_envs
        with gui.add_folder("View"):
            follow = gui.add_checkbox("camera follows", True)
            follow.on_update(lambda event: setattr(scene, "is_following", follow.value))
            if num_envs > 1:
                world = gui.add_dropdown("world", tuple(map(str, range(num_envs))), hint="that camera and plots follow")
                world.on_update(lambda event: by_user(event) and self._session.follow_world(int(world.value)))
                others = gui.add_checkbox("all worlds", True, hint="draw the other worlds too")
                others.on_update(lambda event: setattr(scene, "shows_others", others.value))

    def update(self, state: State) -> None:
        """Show what has changed without a click: new checkpoints, and what was loaded or refused.

        Args:
            state: The session's newest state.
        """
        names = tuple(map(str, sorted({*state.checkpoints, state.checkpoint})))
        if names != tuple(self.checkpoints.options):
            self.checkpoints.options = names
        loaded = (state.checkpoint, state.perturbation, state.message_number)
        if loaded != self._loaded:  # else a choice that is not carried out yet would jump back
            self._loaded = loaded
            set_value(self.checkpoints, str(state.checkpoint))
            set_value(self.perturbation, state.perturbation)
        if state.mixing is not None and not state.is_mixing_set:
            for weight, value in zip(self._weights, state.mixing, strict=True):
                set_value(weight, round(value, 2))


def set_value(handle: viser.GuiInputHandle, value: object) -> None:
    """Set the value of a control if it is another one: each time is a message to the browsers."""
    if handle.value != value:
        handle.value = value
