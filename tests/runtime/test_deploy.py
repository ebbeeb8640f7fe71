"""A policy on a simulated Go2 in another process, over DDS, and the scripts of both sides."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from support.exports import export_random
from support.scripts import ROOT, assert_told_in_one_line, command, run_here

pytest.importorskip("cyclonedds", reason="needs the extra: pip install 'legged_torque[robot]'")

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.runtime.brakes import Brakes
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.dds import Go2Robot
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.loop import PRIORITY
from legged_torque.runtime.session import Session
from legged_torque.runtime.sim_robot import InProcess, SimRobot
from legged_torque.runtime.view import View
from legged_torque.utils.errors import UserError

RATE, DOMAIN, OTHER = 500.0, 200 + os.getpid() % 16, 216 + os.getpid() % 16
SIDE = """
import sys, time
from pathlib import Path
from legged_torque.runtime.dds import Go2Side
from legged_torque.runtime.sim_robot import SimRobot

side = Go2Side("lo", int(sys.argv[1]))
robot = SimRobot(Path(sys.argv[2]), side.joint_order, 500.0)
state, heard = robot.says()[0], None
while True:  # it moves on with each command, and repeats itself until the next one comes
    side.send(state)
    received = side.receive()
    if received.newest is None:
        time.sleep(1e-3)
        continue
    robot.step(received)
    state = robot.says()[0]
    print(*robot.data.qpos[:3], robot.excess, robot.watchdog_ticks, flush=True)
"""


def walk(transport, policy, ticks):
    """Stand up, then let the policy act."""
    controller = Controller(policy, transport.joint_order, RATE, Brakes(stand_up=1.0))
    meet(transport, controller)
    for tick in range(ticks):
        transport.send(controller.step(next_state(transport, controller), tick / RATE))
        if tick == 5:
            assert controller.request(Mode.STAND) == ""
        if tick == round(1.2 * RATE):
            assert controller.request(Mode.POLICY) == ""
    return controller


def next_state(transport, controller):
    """Wait for it, without the pauses of tests that wait for a page; what was lost is said again."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        again = time.monotonic() + 0.1
        while time.monotonic() < again:
            if (received := transport.receive()).newest is not None:
                return received
            time.sleep(1e-4)
        transport.send(controller.sent)
    raise AssertionError("the robot says nothing")


def meet(transport, controller):
    """Tell the robot to damp until it obeys: the first messages are lost while both sides look for each other."""
    first = next_state(transport, controller).newest.tick
    while next_state(transport, controller).newest.tick == first:
        pass


def test_over_the_wire_as_in_process(exported_go2, tmp_path):
    """A robot in another process ends where one in this process does; the wire rounds to float32."""
    policy, ticks, xml = Policy(exported_go2), round(1.3 * RATE), resource_path("resources/robots/go2/go2.xml")
    command = [sys.executable, "-c", SIDE, str(DOMAIN), str(xml)]
    with (tmp_path / "said").open("w") as file, subprocess.Popen(command, stdout=file) as process:
        try:
            transport = Go2Robot("lo", DOMAIN)
            assert walk(transport, policy, ticks).mode == Mode.POLICY
            transport.close()
        finally:
            process.kill()
    *_, last, _ = (tmp_path / "said").read_text().split("\n")  # behind it, maybe a line that was cut by the kill
    *place, excess, watchdog = map(float, last.split())
    robot = SimRobot(xml, transport.joint_order, RATE)
    assert walk(InProcess(robot), policy, ticks).mode == Mode.POLICY
    np.testing.assert_allclose(place, robot.data.qpos[:3], atol=0.01)
    assert place[2] > 0.2 and excess < 1.0 and not watchdog  # a busy machine holds commands


def test_ctrl_c_in_the_farewell(exported_go2, tmp_path, monkeypatch):
    """A first one is only noted."""
    close = Session.close
    monkeypatch.setattr(Session, "close", lambda self: (signal.raise_signal(signal.SIGINT), close(self)))
    assert run_here("deploy.py", str(exported_go2), "--interface=sim", "--seconds=0.1", root=tmp_path)[::2] == (0, "")


def test_only_the_loop_goes_before_other_programs(exported_go2, tmp_path, monkeypatch):
    """What draws the view and writes the log does not."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setscheduler(0, *before)
    except PermissionError:
        pytest.skip("real-time scheduling is not permitted here")
    seen, thread = set(), threading.current_thread
    for kind, name in ((View, "show"), (Log, "write")):
        monkeypatch.setattr(kind, name, lambda self: seen.add((type(self), thread().name, os.sched_getscheduler(0))))
    words = ["--interface=sim", "--seconds=0.1", "--log=log.mcap"]
    assert run_here("deploy.py", str(exported_go2), *words, root=tmp_path)[0] == 0
    aside = {(kind, policy) for kind, name, policy in seen if name != thread().name}
    assert aside == {(View, os.SCHED_OTHER), (Log, os.SCHED_OTHER)}


def test_a_terminal_that_waits(exported_go2, tmp_path):
    """A robot whose view cannot be written, as after Ctrl-S, is logged and stopped in time; its log is whole."""
    (end, full), log = os.pipe(), tmp_path / "log.mcap"
    os.set_blocking(full, False)
    with contextlib.suppress(BlockingIOError):
        while os.write(full, bytes(4096)):
            pass
    os.set_blocking(full, True)
    words = [str(exported_go2), "--interface=sim", "--walk", f"--log={log}"]
    with subprocess.Popen([sys.executable, str(ROOT / "scripts" / "deploy.py"), *words], stdout=full) as process:
        os.close(full)
        until, last, enough = time.monotonic() + 120.0, b"", 200_000
        while not (last.endswith(b"MCAP0\r\n") and len(last) > 1000) and time.monotonic() < until:
            time.sleep(0.1)
            last = log.read_bytes() if log.exists() else b""
            if len(last) > enough:  # a busy machine may stop the robot before, which ends it
                process.send_signal(signal.SIGINT)
                enough = sys.maxsize
        with open(end, "rb") as output:
            said = output.read()
    assert time.monotonic() < until
    assert process.returncode == 0 or b"were missed" in said or b"late ticks" in said  # as on a busy machine
    assert [rest["mode"] for *_, rest in RecordedLog(log).ticks()][-1] == "damping"


def test_a_stop_without_an_operator(exported_go2, tmp_path):
    """A robot that walks by itself and was stopped stays down, and the session ends with the reason."""
    words = [str(ROOT / "scripts" / "deploy.py"), str(exported_go2), "--interface=sim", "--walk", "--log=a.mcap"]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "text": True, "cwd": tmp_path}
    with subprocess.Popen([sys.executable, *words], **pipes) as process:
        assert process.stdout.readline()
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.5)  # longer than any deadline
        process.send_signal(signal.SIGCONT)
        try:
            said, _ = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert process.returncode == 1 and "\nstopped: " in said


def test_an_output_that_nobody_reads_any_more(exported_go2, tmp_path):
    """As after ``| head -1``: the session goes on to its end, and ends well."""
    log = tmp_path / "log.mcap"
    command = [sys.executable, str(ROOT / "scripts" / "deploy.py"), str(exported_go2)]
    command += ["--interface=sim", "--seconds=2", f"--log={log}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().startswith("damping")
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == ("", 0)
    ticks = [tick[0] for tick in RecordedLog(log).ticks()]
    assert ticks[-1] - ticks[0] > 1.5


WITHOUT_TORCH = """
import runpy, sys
for name in ("torch", "warp", "rsl_rl", "mujoco_warp", "tensordict"):
    sys.modules[name] = None  # importing it raises
for sys.argv in %r:
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_scripts_without_torch(exported_go2, tmp_path):
    """What runs on a robot, and replay.py, need none of the packages of training; one file is enough."""
    file = str(exported_go2 / "policy.onnx")
    calls = [["deploy.py", file, "--interface=sim", "--seconds=0.5", "--log=log.mcap"]]
    calls += [["replay.py", "log.mcap", f"--policy={file}"], ["sim_robot.py", "--seconds=0.2", "--domain=231"]]
    calls = [[str(ROOT / "scripts" / script), *words] for script, *words in calls]
    command = [sys.executable, "-c", WITHOUT_TORCH % calls]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "") and "bit by bit" in done.stdout


OWN = """
from legged_torque import resource_path
from legged_torque.runtime.interface import JOINT_ORDER
from legged_torque.runtime.sim_robot import InProcess, SimRobot

class Mine(InProcess):
    def __init__(self):
        super().__init__(SimRobot(resource_path("resources/robots/go2/go2.xml"), JOINT_ORDER, 500.0))

    def receive(self):
        received = super().receive()
        received.newest.identity[:] = 1, 2, 3, 4
        return received

class Older(Mine):
    def __init__(self):
        super().__init__()
        del self.torque_limits

class Numbered(Mine):
    joint_order = property(lambda self: list(range(12)), lambda self, names: None)

class Written(Mine):
    torque_limits = property(lambda self: ["23.7"] * 12, lambda self, limits: None)

class Short(Mine):
    torque_limits = property(lambda self: (23.7,) * 11, lambda self, limits: None)

class Addressed(Mine):
    def __init__(self, address):
        super().__init__()

class Faulty(Mine):
    def __init__(self):
        len(None)
"""


def test_robot_at_the_other_end(make_task, exported_go2, tmp_path, monkeypatch):
    """The robot's name, torque limits and transport are checked before anything moves; its firmware is printed once."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "own_robot.py").write_text(OWN)
    own = ["deploy.py", str(exported_go2), "--interface=own_robot.py:Mine"]
    status, output, _ = run_here(*own, "--robot=go2", "--seconds=0.3", root=tmp_path)
    assert (status, output.count("the robot's firmware is [1, 2], its serial number [3, 4]")) == (0, 1)
    assert_told_in_one_line(run_here(*own, "--robot=a1", root=tmp_path), "--robot must be 'go2'")
    assert_told_in_one_line(run_here(*own, "--domain=1", root=tmp_path), "FILE.py:CLASS do without")
    (tmp_path / "queue.py").write_text(OWN)
    (tmp_path / "no-robot.py").write_text(OWN)
    named, other = "takes a Python file with the name of a module", "there is another module 'queue'"
    wrong = {"own_robot.py:Yours": "no class 'Yours'", "no-robot.py:Mine": named, "queue.py:Mine": other}
    wrong["no_robot.py:Mine"] = "there is no file 'no_robot.py'"
    kinds = "must have joint_order, names, and as many torque_limits, numbers"
    wrong |= dict.fromkeys((f"own_robot.py:{name}" for name in ("Older", "Numbered", "Written", "Short")), kinds)
    wrong |= {"own_robot.py:Addressed": "made without arguments"}
    for given, message in wrong.items():
        assert_told_in_one_line(run_here(*own[:2], f"--interface={given}", root=tmp_path), message)
    with pytest.raises(TypeError):  # a mistake in the class, whose place its author needs
        run_here(*own[:2], "--interface=own_robot.py:Faulty", root=tmp_path)
    stronger = (resource_path("resources/robots/go2/go2.xml")).read_text("utf-8").replace("45.43", "200")
    (tmp_path / "go2.xml").write_text(stronger)
    export_random(make_task, "go2_torque_multihead", tmp_path / "out", **{"asset.file": str(tmp_path / "go2.xml")})
    refused = run_here("deploy.py", "out", *own[2:], root=tmp_path)
    assert_told_in_one_line(refused, "may ask FR_calf_joint for 200 N m, the robot's motor can give 45.43 N m")

    def joined(interface, domain):
        raise UserError(f"{interface} {domain}")

    monkeypatch.setattr("legged_torque.runtime.dds.Go2Robot", joined)
    for words, joins in ((["lo"], "lo 1"), (["eth0"], "eth0 0"), (["lo", "--domain=0"], "lo 0")):
        words = ["deploy.py", str(exported_go2), "--robot=go2", "--interface", *words]
        assert_told_in_one_line(run_here(*words, root=tmp_path), joins)
    status, output, _ = command("sim-robot", "--robot=go2", "--help")
    assert status == 0 and output.startswith("usage: legged-torque sim_robot ")


def test_scripts(make_task, exported_go2, tmp_path):
    """Both scripts begin and end by themselves; what they are told wrongly is refused in one line."""
    own = [str(exported_go2), "--interface=sim", "--seconds=0.3", "--log=log.mcap"]
    status, output, _ = run_here("deploy.py", *own, root=tmp_path)
    assert status == 0 and "damping" in output and "99.9% within" in output
    replay = ["replay.py", "log.mcap", f"--policy={exported_go2}"]
    status, output, _ = run_here(*replay, "--plot=gap.png", root=tmp_path)
    assert status == 0 and "RL_calf_joint: never; 0.0000" in output and (tmp_path / "gap.png").stat().st_size > 1000
    words = ["--interface=lo", f"--domain={OTHER}", "--seconds=0.3"]
    assert run_here("deploy.py", str(exported_go2), *words, root=tmp_path)[0] == 0
    status, output, _ = run_here("sim_robot.py", *words, "--fault=hot=FR_hip_joint", "--fault=lost=1", root=tmp_path)
    assert status == 0 and "sport mode normal" in output
    for script, wrong, message in (
        ("deploy.py", ["--interface=none0"], "unknown network interface 'none0'"),
        ("deploy.py", ["--interface=sim", "--rate=333"], "multiple of the policy's 50 Hz"),
        ("deploy.py", ["--interface=sim", "--command", "2", "0", "0"], "lin_vel_x of --command must be from -1 to 1"),
        ("deploy.py", ["--interface=eth0", "--walk"], "a real one waits for its operator"),
        ("deploy.py", ["--interface=sim", "--log=log.mcap"], "cannot write the log 'log.mcap'"),
        ("deploy.py", ["--interface=sim", "--gamepad=js7"], "cannot open the gamepad 'js7'"),
        ("deploy.py", ["--interface=sdk", "--power=11"], "--power must be from 1 to 10"),
        ("deploy.py", ["--interface=sim", "--power=2"], "--power is for --interface sdk"),
        ("deploy.py", ["--interface=sim", "--domain=0"], "--domain is of DDS"),
        ("deploy.py", ["--interface=sim", "--chirp", "--command", "0", "0", "0"], "--command is for policies"),
        ("deploy.py", ["--interface=lo", "--chirp", "--rate=50"], "at least 100 for the 10 Hz of --chirp, not 50"),
        ("sim_robot.py", ["--motors=rael"], "did you mean 'real'?"),
        ("sim_robot.py", ["--fault=lots=1"], "unknown fault 'lots'; did you mean 'lost'?"),
        ("sim_robot.py", ["--fault=dead=FR_hip"], "did you mean 'FR_hip_joint'?"),
        ("sim_robot.py", ["--fault=lost=many"], "takes a number, not 'many'"),
        ("sim_robot.py", ["--fault=lost=2"], "--fault lost must be from 0 to 1, not 2"),
        ("sim_robot.py", ["--fault=silent=0.3"], "--fault silent takes 0 or 1, not 0.3"),
        ("sim_robot.py", ["--fault=delay=nan"], "--fault delay must be finite"),
    ):
        given = [str(exported_go2)] if script == "deploy.py" else []
        assert_told_in_one_line(run_here(script, *given, *wrong, root=tmp_path), message)
    for words, message in (
        ([*replay, "--limit=-1"], "limit"),
        (["replay.py", "none.mcap", "--policy=none", "--plot=gap"], "a figure needs a name that ends in .png"),
        (["replay.py", "none.mcap", "--policy=none", "--plot=/dev/null/a.png"], "cannot write '/dev/null/a.png'"),
        (["identify.py", "."], "cannot read '.': there is no such file"),
        (["identify.py", "log.mcap", "--out=m.txt"], "--out must end in .yaml or .yml"),
        (["identify.py", "log.mcap"], "'log.mcap' is no log of deploy.py --chirp"),
    ):
        assert_told_in_one_line(run_here(*words, root=tmp_path), message)
    export_random(make_task, "a1_torque", tmp_path / "a1", **{"control.decimation": 1})  # at 200 Hz
    assert run_here("deploy.py", "a1", "--interface=sim", "--seconds=0.3", "--log=fast.mcap", root=tmp_path)[0] == 0
    assert RecordedLog(tmp_path / "fast.mcap").period == 1 / 400
    refused = run_here("deploy.py", "a1", "--interface=lo", root=tmp_path)
    assert_told_in_one_line(refused, "the policy is of the robot 'a1'")
