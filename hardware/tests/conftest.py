import pytest

import parts
from design import Design
from mechanism import build


@pytest.fixture(scope="session")
def design():
    return Design()


@pytest.fixture(scope="session")
def mechanism(design):
    return build(design)


@pytest.fixture(scope="session")
def printed(design):
    return parts.printed(design)
