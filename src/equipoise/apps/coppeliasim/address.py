"""Addresses of worlds in CoppeliaSim, and the numbers of such a world.

`coppeliasim://HOST:PORT` is the paper's world: a kinematic arm in CoppeliaSim, the joints of which
are set, and a pendulum that Equipoise integrates. With `?engine=NAME` arm and pendulum move under
forces in that physics engine, behind the drives of CoppeliaSim; `&twin=NAME` takes masses,
frictions, delay and encoder from another twin than `twin:nominal`.
"""

from typing import Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from equipoise.artefacts import quoted
from equipoise.errors import SettingsError
from equipoise.model.worlds import PREFIX as TWIN_PREFIX
from equipoise.model.worlds import TwinSettings, read_world

PREFIX: Final = "coppeliasim://"
"""Prefix of the addresses of worlds in CoppeliaSim."""
FORM: Final = f"{PREFIX}HOST:PORT, {PREFIX}HOST:PORT?engine=mujoco or ...&twin=NAME"
"""Form of an address, for messages."""
PORT: Final = 23000
"""Default port of CoppeliaSim's server of the ZeroMQ remote API."""
MUJOCO: Final = "mujoco"
"""Name of the one engine of CoppeliaSim that knows rotors and the friction of a joint."""
ENGINES: Final = (MUJOCO, "bullet", "ode", "newton", "vortex")
"""Physics engines of CoppeliaSim, by the names of its constants."""
SETPOINT_PERIOD: Final = 0.005
"""Time between two setpoints, and step of the simulation with an engine [s]."""


class Address(NamedTuple):
    """Address of a world in CoppeliaSim."""

    host: str
    """Name or address of the machine."""
    port: int
    """Port of the server."""
    engine: str | None
    """Physics engine; None for the kinematic arm."""
    numbers: TwinSettings | None
    """Numbers that act with an engine; None for the kinematic arm."""


def is_address(world: object) -> bool:
    """Return whether a world is an address of CoppeliaSim."""
    return isinstance(world, str) and world.startswith(PREFIX)


def read_address(text: str) -> Address:
    """Return the parts of an address.

    Args:
        text: `coppeliasim://HOST`, with `:PORT`, `?engine=NAME` and `&twin=NAME` where needed.

    Raises:
        SettingsError: The address has another form, or names an unknown engine or twin.

    Example:
        >>> read_address("coppeliasim://localhost").port
        23000
        >>> read_address("coppeliasim://localhost?engine=mujoco").numbers.transport
        0.01
    """
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", PORT if parts.port is None else parts.port
        query = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise _wrong(text) from None
    options = dict(query)
    known = set(options) <= {"engine", "twin"} and len(options) == len(query)
    rest = parts.path.strip("/") or parts.fragment or parts.username
    if not (text.startswith(PREFIX) and host and port and known) or rest:
        raise _wrong(text)
    engine, twin = options.get("engine"), options.get("twin")
    if engine is None:
        if twin is not None:
            raise SettingsError(
                f"the world {quoted(text)} names a twin for the kinematic arm, which has no "
                f"masses; add an engine: {PREFIX}HOST:PORT?engine={MUJOCO}&twin={twin}"
            )
        return Address(host, port, None, None)
    if engine not in ENGINES:
        raise SettingsError(
            f"the world {quoted(text)} names the engine {quoted(engine)}; choose one of "
            f"{', '.join(ENGINES)}"
        )
    return Address(host, port, engine, _acting(twin or "nominal", engine))


def _wrong(text: str) -> SettingsError:
    return SettingsError(f"{quoted(text)} is no address of CoppeliaSim; expected {FORM}")


def _acting(twin: str, engine: str) -> TwinSettings:
    """Return the numbers of a twin as far as they act in CoppeliaSim."""
    settings = read_world(TWIN_PREFIX + twin.removeprefix(TWIN_PREFIX)).settings
    changes = {
        "transport": round(settings.transport / SETPOINT_PERIOD) * SETPOINT_PERIOD,
        "transport_jitter": 0.0,
        "cycle": 1,
        "shaped": False,
        "inner": "velocity",
        "encoder_age": 0.0,
        "encoder_jitter": 0.0,
        "reply_age": 0.0,
        "joint_noise": 0.0,
        "drag": 0.0,
        "substeps": 1,
    }
    if engine != MUJOCO:
        changes |= {"coulomb": 0.0, "rotor_inertia": 0.0}
    return settings.model_copy(update=changes)
