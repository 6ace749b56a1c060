"""What the application imports before anybody asks for it."""

import subprocess
import sys

import pytest

SLOW = {
    "dash": "comes with Open3D, nobody needs it",
    "matplotlib": "comes with Open3D, nobody needs it",
    "open3d": "a second and more; only the simulated rig needs it, when it is opened",
    "plotly": "comes with Open3D, nobody needs it",
}
"""Package -> why it mustn't be imported at start."""


@pytest.mark.parametrize("module", ["backend.main", "backend.cli.application", "app.session"])
def test_slow_packages_wait_until_they_are_needed(module: str) -> None:
    program = f"import sys, {module}; print(*{set(SLOW)} & sys.modules.keys())"
    done = subprocess.run(
        [sys.executable, "-c", program], text=True, capture_output=True, check=True
    )

    assert {name: SLOW[name] for name in done.stdout.split()} == {}
