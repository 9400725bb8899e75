"""`equipoise rig emulate` as a program of its own: what stands on its port and its terminal."""

import json
import os
import socket

import pytest

from tests.program import program


@pytest.mark.full
def test_robot_and_board_answer_and_ctrl_c_ends_it_well(tmp_path):
    link = tmp_path / "encoder"
    options = ("--port", "0", "--encoder-link", str(link), "--json")
    with program("rig", "emulate", *options) as it:
        ready = json.loads(it.find(r"\{.*\}")[0])
        assert ready["encoder"] == f"serial://{link}"
        assert os.read(os.open(link, os.O_RDONLY | os.O_NOCTTY), 64)
        it.process.stdin.write("press\nnonsense\n")
        it.process.stdin.flush()
        port = int(ready["robot"].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=5.0) as robot:
            robot.sendall(b"getJointsPositions\n")
            # It stands beside home, whose first joint is at a quarter of a turn.
            first = float(robot.recv(1024).split(b"_")[0])
            assert first == pytest.approx(1.571 - 0.105, abs=0.01)
        assert it.end() == 0
    assert not link.is_symlink()
