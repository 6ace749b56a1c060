"""The conformance suite for any rig, without writing a test.

`unglare rigs conform --rig NAME` runs it; so does pytest by itself::

    pytest -p backend.devices.rig_suite --pyargs backend.devices.rig_suite --rig my_package:create_rig

The rig is a name, `package.module:factory`, or the path of a rig file whose projector needs no page.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.register_assert_rewrite("backend.devices.conformance")  # so that a failure says which values

from backend.devices.conformance import RigConformance  # noqa: E402  after the line above
from backend.devices.loading import open_rig  # noqa: E402  after the line above
from backend.devices.pages import PageDesk  # noqa: E402  after the line above
from backend.devices.protocols import Rig  # noqa: E402  after the line above
from backend.devices.rig_file import RigFile, assemble  # noqa: E402  after the line above

MAKE = pytest.StashKey[Callable[[], Rig]]()
"""What makes the rig, where pytest is called by a program."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take the rig, and how bright it is."""
    group = parser.getgroup("unglare", "the rig under test")
    group.addoption("--rig", default="", help="name, package.module:factory, or a rig file")
    group.addoption(
        "--rig-option", action="append", default=[], metavar="KEY=VALUE", help="of its factory"
    )
    group.addoption(
        "--light", action="store_true", help="the cameras see something that the projector lights"
    )
    group.addoption(
        "--exposure-ms", type=float, default=50.0, help="at which white gives a good picture"
    )


class TestRig(RigConformance):
    """The rig that the command line names."""

    @pytest.fixture(autouse=True)
    def _bright(self, request: pytest.FixtureRequest) -> None:
        self.has_light = request.config.getoption("light")
        self.exposure_us = 1000.0 * request.config.getoption("exposure_ms")

    @pytest.fixture
    def rig(self, pytestconfig: pytest.Config) -> Iterator[Rig]:
        """Open the rig for one test."""
        make = pytestconfig.stash.get(MAKE, lambda: _named(pytestconfig))
        with make() as rig:
            yield rig


def _named(config: pytest.Config) -> Rig:
    name = config.getoption("rig")
    if not name:
        raise pytest.UsageError("say which rig: --rig NAME, package.module:factory or FILE.yaml")
    options = dict(text.partition("=")[::2] for text in config.getoption("rig_option"))
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return assemble(path.stem, RigFile.read(path), PageDesk())
    return open_rig(name, options)
