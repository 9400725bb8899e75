"""`equipoise rig emulate` as a program of its own: what stands on its port and its terminal."""

import json
import os
import re
import socket

import pytest

from tests.program import program


def ask(connection, command):
    connection.sendall(command)
    answer = b""
    while not answer.endswith(b"\n"):
        answer += connection.recv(1024)
    return answer.decode()


@pytest.mark.full
def test_robot_and_board_answer_and_ctrl_c_ends_it_well(tmp_path):
    link = tmp_path / "encoder"
    options = ("--port", "0", "--encoder-link", str(link), "--json")
    with program("rig", "emulate", *options) as it:
        ready = json.loads(it.find(r"\{.*\}")[0])
        port = int(ready["robot"].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=5.0) as robot:
            answer = ask(robot, b"getJointsPositions\n")
            assert re.fullmatch(r"(-?[0-9.E-]+_){7}\n", answer)
            # It stands beside home, whose first joint is at a quarter of a turn.
            assert float(answer.split("_")[0]) == pytest.approx(1.571 - 0.105, abs=0.01)
            assert ask(robot, b"startDirectServoJoints\n") == "done\n"
            assert ready["encoder"] == f"serial://{link}"
            assert os.read(os.open(link, os.O_RDONLY | os.O_NOCTTY), 64)
            it.process.stdin.write("press\nnonsense\n")
            it.process.stdin.flush()
        assert it.end() == 0
    assert not link.is_symlink()
