"""The controls of the page, which turn clicks into requests to the session."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import viser

from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import FASTEST, SLOWEST, Session
from legged_torque.viewer.state import SessionState

DIRECTIONS = {"from behind": 0.0, "from the right": 90.0, "from the front": 180.0, "from the left": -90.0}
"""Where a push comes from, and its direction from the robot's front to its left [degrees]."""


def on_user_change(control: viser.GuiInputHandle, callback: Callable[[], None]) -> None:
    """Call a function whenever a user changes a control; changes by this program do not count."""

    def changed(event: viser.GuiEvent) -> None:
        if event.client is not None:
            callback()

    control.on_update(changed)


def connect(
    sliders: Sequence[viser.GuiInputHandle[float]],
    automatic: viser.GuiInputHandle[bool],
    ask: Callable[[list[float] | None], None],
) -> None:
    """Ask for the values of sliders, or for None while a checkbox is ticked; moving a slider unticks it."""

    def choose() -> None:
        automatic.value = False
        toggle()

    def toggle() -> None:
        ask(None if automatic.value else [slider.value for slider in sliders])

    for slider in sliders:
        on_user_change(slider, choose)
    on_user_change(automatic, toggle)


KEYS = "or hold W A S D, arrows, or a gamepad's sticks"


class Controls:
    """The panel with all controls."""

    def __init__(self, server: viser.ViserServer, session: Session, scene: Scene) -> None:
        """Build the panel."""
        self._gui, self._session, self._scene = server.gui, session, scene
        self._ground = scene.ground
        self._loaded: tuple[int, str, int, bool] | None = None
        self._weights: dict[str, viser.GuiInputHandle[float]] = {}
        self.status = self._gui.add_html("")
        self._add_command()
        self._add_time()
        self._add_push()
        self._add_run()
        self._add_mixing()
        self._add_tile()
        self._add_view()

    def _add_command(self) -> None:
        """Add the commanded velocities; moving a slider ends random commands."""
        gui, session, ranges = self._gui, self._session, self._session.task.cfg.commands.ranges
        limits = {"x [m/s]": ranges.lin_vel_x, "y [m/s]": ranges.lin_vel_y, "yaw [rad/s]": ranges.ang_vel_yaw}
        hints = ("forward", "to the left", "turning to the left")
        with gui.add_folder("Command"):
            self._random = automatic = gui.add_checkbox("random", True, hint="drawn as in training, for each world")
            self._sliders = sliders = [
                gui.add_slider(label, low, max(high, low + 0.05), 0.05, min(max(0.0, low), high), hint=hint)
                for (label, (low, high)), hint in zip(limits.items(), hints, strict=True)
            ]
            gui.add_html(f'<div style="font-size:12px;padding:0 12px">{KEYS}</div>')
            stand = gui.add_button("Stand still", icon="hand-stop")

        def ask(values: list[float] | None) -> None:
            session.set_command(None if values is None else (values[0], values[1], values[2]))

        connect(sliders, automatic, ask)
        stand.on_click(lambda event: self.steer((0.0, 0.0, 0.0)))

    def steer(self, shares: Sequence[float]) -> None:
        """Command shares, -1 to 1, of the sliders' ends, as keys and gamepads do."""
        ends = [slider.max if share > 0.0 else -slider.min for slider, share in zip(self._sliders, shares, strict=True)]
        x, y, yaw = (share * end for share, end in zip(shares, ends, strict=True))
        self._show_command((x, y, yaw))
        self._session.set_command((x, y, yaw))

    def _show_command(self, command: Sequence[float]) -> None:
        """Let the sliders show a command that is not random."""
        self._random.value = False
        self._follow(command)

    def _follow(self, command: Sequence[float]) -> None:
        """Move the sliders to a command, as far as they go."""
        for slider, value in zip(self._sliders, command, strict=True):
            set_value(slider, round(min(max(value, slider.min), slider.max), 2))

    def _add_time(self) -> None:
        """Add pause, reset and speed."""
        gui, session = self._gui, self._session
        with gui.add_folder("Time"):
            pause = gui.add_checkbox("pause", False)
            speed = gui.add_slider("speed [x]", SLOWEST, FASTEST, 0.1, FASTEST, hint="1 is real time")
            reset = gui.add_button("Reset", icon="rotate", hint="a new episode in every world")
        on_user_change(pause, lambda: session.set_paused(pause.value))
        on_user_change(speed, lambda: session.set_speed(speed.value))
        reset.on_click(lambda event: session.reset())

    def _add_push(self) -> None:
        """Add pushes."""
        gui = self._gui
        with gui.add_folder("Push"):
            direction = gui.add_dropdown("push", tuple(DIRECTIONS))
            hint = "added to the trunk's velocity at once"
            strength = gui.add_slider("strength [m/s]", 0.1, 2.0, 0.1, 0.8, hint=hint)
            push = gui.add_button("Push", icon="arrow-big-right")
        push.on_click(lambda event: self._session.push(math.radians(DIRECTIONS[direction.value]), strength.value))

    def _add_run(self) -> None:
        """Add checkpoints and perturbations."""
        gui, session, state = self._gui, self._session, self._session.state
        with gui.add_folder("Run"):
            names = tuple(map(str, state.checkpoints)) or (str(state.checkpoint),)
            self.checkpoints = gui.add_dropdown("checkpoint", names, initial_value=str(state.checkpoint))
            hint = "load each new checkpoint as soon as it is saved"
            self.newest = newest = gui.add_checkbox("follow training", False, hint=hint)
            companion = session.companion
            if companion:
                others = tuple(map(str, companion.state.checkpoints))
                other = gui.add_dropdown("beside", others, initial_value=str(companion.state.checkpoint))
                on_user_change(other, lambda: companion.load_checkpoint(int(other.value)))
            hint = "random parameters, pushes and noise; rebuilds the worlds"
            self.perturbation = gui.add_dropdown("perturbation", tuple(session.perturbations()), hint=hint)

        def load() -> None:
            newest.value = False
            session.follow_newest(False)
            session.load_checkpoint(int(self.checkpoints.value))

        on_user_change(self.checkpoints, load)
        on_user_change(newest, lambda: session.follow_newest(newest.value))
        on_user_change(self.perturbation, lambda: session.set_perturbation(self.perturbation.value))

    def _add_mixing(self) -> None:
        """Add the weights of action terms, for a task that has them."""
        gui, mixing = self._gui, self._session.state.mixing
        if not mixing:
            return
        with gui.add_folder("Mixing weights"):
            automatic = gui.add_checkbox("as in training", True, hint="the weights at this point of the training")
            for name, weight in mixing.items():
                start = min(max(weight, 0.0), 1.0)
                self._weights[name] = gui.add_slider(name.replace("_", " "), 0.0, 1.0, 0.05, start)
        connect(list(self._weights.values()), automatic, self._session.set_mixing)

    def _add_tile(self) -> None:
        """Add the tile of the followed robot, for a task on rough ground."""
        self._tile: list[int] = []
        if not self._ground:
            return
        gui, session, layout = self._gui, self._session, self._ground.layout
        self._kinds = layout.kinds()
        with gui.add_folder("Tile"):
            names = tuple(dict.fromkeys(self._kinds))
            self.kind = gui.add_dropdown("kind", names, hint="moves the followed robot onto such a tile")
            hint = "the first is the easiest"
            self.level = gui.add_slider("level", 0, max(layout.num_rows - 1, 1), 1, 0, hint=hint)
            self.level.disabled = layout.num_rows == 1

        def move() -> None:
            session.set_tile(self.level.value, self._kinds.index(self.kind.value))

        on_user_change(self.kind, move)
        on_user_change(self.level, move)

    def _add_view(self) -> None:
        """Add what is drawn; drawing needs no step, so that these controls act at once."""
        gui, scene, num_envs = self._gui, self._scene, self._session.task.num_envs
        with gui.add_folder("View"):
            follow = gui.add_checkbox("camera follows", True)
            follow.on_update(lambda event: setattr(scene, "is_following", follow.value))
            if num_envs > 1:
                world = gui.add_dropdown("world", tuple(map(str, range(num_envs))), hint="for camera and plots")
                on_user_change(world, lambda: self._session.follow_world(int(world.value)))
                others = gui.add_checkbox("all worlds", True, hint="draw the other worlds too")
                others.on_update(lambda event: setattr(scene, "shows_others", others.value))
            layers = scene.layers
            for label, name, hint in (
                ("contacts", "shows_contacts", "points and forces, 1 m for 500 N"),
                ("collision geoms", "shows_collision", "what touches the ground in the simulator"),
                ("ghost", "shows_ghost", "where the commands of the last second lead"),
            ):
                box = gui.add_checkbox(label, getattr(layers, name), hint=hint)
                box.on_update(lambda event, name=name: setattr(layers, name, event.target.value))
            if self._ground:
                scan = gui.add_checkbox("height scan", scene.shows_scan, hint="where the ground is measured")
                scan.on_update(lambda event: setattr(scene, "shows_scan", scan.value))

    def update(self, state: SessionState) -> None:
        """Show changes that no click has made: new checkpoints, what was loaded, what was refused."""
        names = tuple(map(str, sorted({*state.checkpoints, state.checkpoint})))
        if names != tuple(self.checkpoints.options):
            self.checkpoints.options = names
        loaded = (state.checkpoint, state.perturbation, state.message_number, state.follows_newest)
        if self._loaded is None and state.command is not None:  # one that was there before the page
            self._show_command(state.command)
        if loaded != self._loaded:  # otherwise a choice that is not carried out yet would jump back
            self._loaded = loaded
            set_value(self.checkpoints, str(state.checkpoint))
            set_value(self.perturbation, state.perturbation)
            set_value(self.newest, state.follows_newest)
        tile = [] if state.reading is None else state.reading.tile.astype(int).tolist()
        if tile != self._tile:  # as above
            self._tile = tile
            set_value(self.level, tile[0])
            set_value(self.kind, self._kinds[tile[1]])
        if self._random.value and state.reading is not None:
            self._follow(state.reading.commands[state.world].tolist())
        if not state.is_mixing_set:
            for name, weight in state.mixing.items():
                set_value(self._weights[name], round(weight, 2))


def set_value(handle: viser.GuiInputHandle, value: object) -> None:
    """Set the value of a control if it has changed: each time is a message to the browsers."""
    if handle.value != value:
        handle.value = value
