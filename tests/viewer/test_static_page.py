"""What a published page refuses, and files that it takes along; test_static_browser.py opens it."""

import copy
import socket
import threading
from types import SimpleNamespace

import mujoco
import pytest

from legged_torque.deploy.policy import Policy
from legged_torque.utils.errors import UserError
from legged_torque.viewer import static_page

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def test_refused():
    """All that the page cannot compute is named at once; a policy without any of it passes."""
    policy = Policy("go2/torque_multihead")
    static_page.check(policy)
    changed = copy.deepcopy(policy.description)
    changed["observations"]["history_length"] = 2
    changed["observations"]["terms"].append({"name": "height_scan"})
    changed["actions"]["terms"][0] |= {"interval": 4}
    changed["network"]["memory"] = ["gru"]
    changed["motors"] |= {"drive": {"model": "drive"}, "heat": {"model": "thermal"}}
    named = r"the observation height.*interval of position_residual; .*history.*; a recurrent network; the motor heat"
    with pytest.raises(UserError, match=named):
        static_page.check(SimpleNamespace(description=changed))


def test_what_the_page_leaves_out():
    """Latency of any kind is named, also that of packets that are lost."""
    exact = {"range": [0, 0], "unit": "physics_steps", "jitter": 0, "loss": 0.0}
    description = {"latency": {"actions": exact, "measurements": exact | {"loss": 0.1}}}
    assert static_page.differences(description) == ["latency of measurements: none"]


def test_files_of_the_robot(tmp_path):
    """A mesh of another folder is copied beside the MJCF, which reads it there; the mass stays the same."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "part.obj").write_text(TETRAHEDRON)
    mesh, body = '<mesh name="part" file="part.obj"/>', '<body><freejoint/><geom type="mesh" mesh="part"/></body>'
    text = f'<mujoco><compiler meshdir="meshes"/><asset>{mesh}</asset><worldbody>{body}</worldbody></mujoco>'
    (tmp_path / "robot.xml").write_text(text)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "robot.xml"))
    mass = spec.compile().body_mass[1]
    names = static_page.write_robot(tmp_path / "out", SimpleNamespace(spec=spec, file=tmp_path / "robot.xml"))
    assert names == ["robot.xml", "1.obj"] == sorted((path.name for path in (tmp_path / "out").iterdir()), reverse=True)
    (tmp_path / "meshes" / "part.obj").unlink()
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "robot.xml")).body_mass[1] == pytest.approx(mass)


def answer_in_part(server):
    """Announce more bytes than follow."""
    connection, _ = server.accept()
    with connection:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\npart")


def test_libraries(tmp_path, monkeypatch):
    """Without the registry, and with another file than the one that is expected, nothing is used."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(static_page, "REGISTRY", "http://127.0.0.1:9/")
    package, (checksum, _) = next(iter(static_page.PACKAGES.items()))
    with pytest.raises(UserError, match=r"cannot download http://127.0.0.1:9/@mujoco"):
        static_page.library(package, checksum)
    with socket.create_server(("127.0.0.1", 0)) as cut_off:
        threading.Thread(target=answer_in_part, args=(cut_off,)).start()
        monkeypatch.setattr(static_page, "REGISTRY", f"http://127.0.0.1:{cut_off.getsockname()[1]}/")
        with pytest.raises(UserError, match="cannot download"):
            static_page.library(package, checksum)
    (tmp_path / "other.tgz").write_bytes(b"other")
    monkeypatch.setattr(static_page, "REGISTRY", tmp_path.as_uri() + "/")
    with pytest.raises(UserError, match=r"other.tgz is not the file that was expected"):
        static_page.library("other.tgz", checksum)
    assert not (tmp_path / "legged_torque").exists()
