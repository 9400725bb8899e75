"""Arms by name and by file."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from equipoise.errors import ArmError, InputError
from equipoise.model.arms import resolve
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.resolve import resolve_arm
from equipoise.model.arms.urdf import read_urdf
from tests.model.arms.witnesses import ELBOW, ELBOW_HOME


@pytest.fixture
def registered(monkeypatch):
    """Replace the registered arms."""

    def register(**arms):
        points = [EntryPoint(name, value, resolve.GROUP) for name, value in arms.items()]
        monkeypatch.setattr(resolve, "entry_points", lambda group: EntryPoints(points))

    return register


def test_the_iiwas_are_registered():
    assert resolve_arm("iiwa7") == iiwa(7)
    assert resolve_arm("iiwa14") == iiwa(14)


def test_a_file_is_read_with_all_that_it_does_not_say():
    pivot = (0.0, 0.1, 0.02)
    arm = resolve_arm(
        str(ELBOW), base="pedestal", tip="adapter", acceleration=5.0, home=ELBOW_HOME, pivot=pivot
    )
    expected = read_urdf(
        ELBOW, base="pedestal", tip="adapter", acceleration=5.0, home=ELBOW_HOME, pivot=pivot
    )
    assert arm == expected


def test_a_registered_arm_may_stand_at_another_home_with_another_pivot():
    home, pivot = (0.1, 0.2, 0.0, -1.0, 0.3, 0.4, 0.5), (0.0, 0.0, 0.1)
    arm = resolve_arm("iiwa7", home=home, pivot=pivot)
    assert (arm.home, arm.pivot, arm.digest) == (home, pivot, iiwa(7).digest)
    with pytest.raises(ArmError, match="joint 2"):
        resolve_arm("iiwa7", home=(0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def test_an_arm_of_a_guest_is_found_by_its_name(registered):
    registered(guest="equipoise.model.arms.iiwa:iiwa14")
    assert resolve_arm("guest") == iiwa(14)
    with pytest.raises(ArmError, match=r"no arm 'iiwa7'; choose guest or a file that ends in"):
        resolve_arm("iiwa7")


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("no_such_module:arm", "raised ModuleNotFoundError"),
        ("equipoise.model.arms.iiwa:iiwa", "raised TypeError"),
        ("sys:exit", "raised SystemExit"),
        ("equipoise.paper:__name__.upper", "is a str, expected an equipoise.Arm"),
    ],
)
def test_a_guest_that_is_broken_is_named(registered, value, says):
    registered(guest=value)
    with pytest.raises(InputError, match=f"the arm guest of {value}.* {says}"):
        resolve_arm("guest")


def test_options_of_a_urdf_do_not_fit_a_registered_arm():
    with pytest.raises(ArmError, match="held and tip belong to an arm from a URDF, and iiwa7"):
        resolve_arm("iiwa7", held=3, tip="flange")
