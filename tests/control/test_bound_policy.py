"""Policies by name: every kind is read, checked, clipped, and sent to another process."""

import pickle
import sys

import numpy as np
import pytest

from equipoise import Pendulum, Settings, iiwa, paper, shipped_pendulum
from equipoise.control.bound_policy import BUILT_IN, load_policy
from equipoise.control.linear import lqr_gains
from equipoise.control.policy import act, shipped_policy
from equipoise.errors import ArtefactError, InputError, MissingExtraError
from tests.reference.onnx_network import DOUBLE, FLOAT, linear_network

GAINS = lqr_gains(shipped_pendulum().parameters(), 0.01)
COLUMN = [[gain] for gain in GAINS]
OBSERVATION = np.array([0.05, -0.1, 0.02, -0.15])
SOURCE = f"""
import numpy
G = {GAINS}

def lqr(observation):
    x, x_dot, phi, phi_dot = observation
    return G[0] * x + G[1] * x_dot + G[2] * phi + G[3] * phi_dot

class Counting:
    def __init__(self):
        self.calls = 0

    def act(self, observation):
        self.calls += 1
        return 0.1 * self.calls

class Resetting(Counting):
    def reset(self):
        self.calls = 10

instance = Resetting()
number = 3

class Actless:
    pass

class Needy(Counting):
    def __init__(self, gain):
        self.gain = gain

def raises(observation):
    return 1.0 / 0.0

def mutates(observation):
    observation[:] = 7.0
    return float("nan")

def text(observation):
    return "1.0"

def array(observation):
    return numpy.array([[0.25]], numpy.float32)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with policies of all kinds, which is the current one."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "guest.py").write_text(SOURCE)
    (tmp_path / "lqr.onnx").write_bytes(linear_network(COLUMN))
    shipped_policy().save(tmp_path / "table.json", command="test")
    yield tmp_path
    sys.modules.pop("guest", None)


KINDS = [
    *BUILT_IN,
    *("table.json", "guest:lqr", "guest:Counting", "guest:instance"),
    pytest.param("lqr.onnx", marks=pytest.mark.full),
]


def three_acts(policy):
    policy.reset()
    return [policy.act(OBSERVATION.copy()) for _ in range(3)]


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_acts_and_begins_anew_and_has_a_task_and_a_digest(folder, name):
    policy = load_policy(name)
    there = pickle.loads(pickle.dumps(policy))  # in another process
    before, again, elsewhere = map(three_acts, (policy, policy, there))
    assert before == again == elsewhere
    assert there.digest == policy.digest
    assert all(isinstance(u, float) and abs(u) <= 2.0 for u in before)
    assert policy.digest.startswith("sha256:")
    assert policy.digest == load_policy(name).digest
    assert policy.pendulum == shipped_pendulum()
    assert (policy.arm, policy.h) == (iiwa(7), 0.01)
    if policy.kernel is not None and name != "random":
        assert act(policy.kernel, OBSERVATION, 0.0) == before[0]


@pytest.mark.parametrize(
    ("name", "first", "third"), [("Counting", 0.1, 0.3), ("instance", 1.1, 1.3)]
)
def test_a_reset_calls_the_policys_own_or_makes_its_class_anew(folder, name, first, third):
    policy = load_policy(f"guest:{name}")
    for _ in range(2):
        assert three_acts(policy)[::2] == pytest.approx([first, third])


def test_u_is_clipped_to_the_largest_acceleration_and_may_be_an_array_of_one(folder):
    assert load_policy("guest:lqr").act(np.array([0.0, 0.0, 0.15, 0.0])) == 2.0
    assert load_policy("guest:lqr").act(np.array([0.0, 0.0, -0.15, 0.0])) == -2.0
    assert load_policy("guest:array").act(OBSERVATION) == 0.25


@pytest.mark.parametrize("name", ["raises", "mutates", "text"])
def test_a_policy_that_raises_or_returns_no_finite_number_is_named_with_the_state(folder, name):
    with pytest.raises(InputError, match=f"guest:{name} .* x = 0.05"):
        load_policy(f"guest:{name}").act(OBSERVATION.copy())


@pytest.mark.parametrize(
    "name",
    [
        *("guest:number", "guest:Actless", "guest:Needy", "guest:nothing", "nowhere:act"),
        *("guest.py", "guest:", "missing.json", "missing.onnx"),
    ],
)
def test_an_impossible_name_is_refused(folder, name):
    with pytest.raises(InputError, match=name.split(":")[0].removesuffix(".py")):
        load_policy(name)


def test_a_table_is_refused_for_another_task_and_other_policies_take_it(folder):
    other = Pendulum.assumed(50.0, 0.1)
    for task in ({"pendulum": other}, {"arm": iiwa(14)}, {"settings": Settings()}):
        with pytest.raises((ArtefactError, InputError)):
            load_policy("table.json", **task)
        bound = load_policy("lqr", **task)
        assert all(getattr(bound, what) == value for what, value in task.items())
    assert load_policy("lqr", pendulum=other).digest != load_policy("lqr").digest
    assert load_policy("table.json", pendulum=shipped_pendulum(), arm=iiwa(7)) == shipped_policy()


# Networks


@pytest.mark.full
@pytest.mark.parametrize(
    ("batch", "element", "tolerance"), [(1, DOUBLE, 1e-12), ("batch", FLOAT, 1e-5)]
)
def test_a_linear_network_commands_what_the_same_law_in_python_does(
    folder, batch, element, tolerance
):
    network = linear_network(COLUMN, inputs=(batch, 4), outputs=(batch, 1), element=element)
    (folder / "net.onnx").write_bytes(network)
    policy, law = load_policy("net.onnx"), load_policy("guest:lqr")
    for observation in np.random.default_rng(0).uniform(-0.05, 0.05, (50, 4)):
        assert policy.act(observation) == pytest.approx(law.act(observation), abs=tolerance)


@pytest.mark.full
def test_an_integer_of_a_network_is_the_index_of_an_action(folder):
    weights = np.random.default_rng(1).normal(size=(4, 9))
    weights[:, 8] *= 10.0
    for count in (8, 9):
        network = linear_network(weights[:, :count].tolist(), index=True)
        (folder / f"best{count}.onnx").write_bytes(network)
    policy, wide = load_policy("best8.onnx"), load_policy("best9.onnx")
    for observation in np.random.default_rng(0).uniform(-0.05, 0.05, (50, 4)):
        expected = paper.ACTIONS[np.argmax(observation @ weights[:, :8])]
        assert policy.act(observation) == expected
    with pytest.raises(InputError, match="best9.onnx returned the action 8, expected 0 to 7"):
        wide.act(weights[:, 8])


@pytest.mark.full
@pytest.mark.parametrize(
    "network",
    [
        linear_network([[1.0]] * 5, inputs=(1, 5)),
        linear_network([[1.0, 2.0]] * 4, outputs=(1, 2)),
        b"no network",
    ],
)
def test_another_network_is_refused(folder, network):
    (folder / "net.onnx").write_bytes(network)
    with pytest.raises(InputError, match="net.onnx"):
        load_policy("net.onnx")


def test_without_the_extra_a_message_says_what_installs_it(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"pip install onnxruntime \(or '\.\[onnx\]'"):
        load_policy("lqr.onnx")
