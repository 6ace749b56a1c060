"""What runs with the application is permissively licensed."""

import re
from importlib import metadata
from pathlib import Path

import pytest

WEAK_COPYLEFT_WITH_REASON: dict[str, str] = {}
"""Package -> why its LGPL is acceptable. Empty: nothing of the kind is needed."""

LICENCE_NOT_IN_METADATA: dict[str, str] = {}
"""Package -> its licence, read in its source, if the metadata don't say."""


def licence(package: str) -> str:
    """Return all that a package says of its licence, the body of a licence text cut off."""
    fields = metadata.metadata(package)
    classifiers = [c for c in fields.get_all("Classifier") or [] if c.startswith("License ::")]
    texts = (fields.get_all("License-Expression") or []) + (fields.get_all("License") or [])
    said = [*(text.strip().split("\n")[0] for text in texts), *classifiers]
    return "; ".join(s for s in said if s and s != "UNKNOWN")


def strength(text: str) -> str:
    """Return "strong", "weak" or "permissive": what the licence asks of those who use the package."""
    alternatives = [one_strength(part) for part in re.split(r"\s+OR\s+", text)]
    return min(alternatives, key=("permissive", "weak", "strong").index)


def one_strength(text: str) -> str:
    if re.search(r"LGPL|Lesser General Public", text):
        return "weak"
    if re.search(r"GPL|General Public|SSPL|EUPL|CeCILL|CC[- ]BY[- ]NC|Business Source", text):
        return "strong"
    return "permissive"


def locked(root: Path) -> list[str]:
    """Return the packages that run with the application, as far as this platform has them."""
    text = (root / "requirements.lock").read_text(encoding="utf-8")
    names = sorted(set(re.findall(r"^([a-z0-9._-]+)==", text, re.MULTILINE)))
    installed = {re.sub(r"[-_.]+", "-", d.name).lower() for d in metadata.distributions()}
    return [name for name in names if name in installed]


def test_the_whole_runtime_is_permissive(root: Path) -> None:
    packages = locked(root)
    licences = {name: licence(name) for name in packages}
    licences |= {name: text for name, text in LICENCE_NOT_IN_METADATA.items() if name in licences}

    assert len(packages) > 50
    assert [name for name, text in licences.items() if not text] == []
    assert {n: text for n, text in licences.items() if strength(text) == "strong"} == {}
    weak = {name for name, text in licences.items() if strength(text) == "weak"}
    assert weak == WEAK_COPYLEFT_WITH_REASON.keys()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("MIT", "permissive"),
        ("MPL-2.0 AND MIT", "permissive"),
        ("GPL-3.0-or-later", "strong"),
        ("License :: OSI Approved :: GNU Affero General Public License v3", "strong"),
        ("LGPL-3.0-only", "weak"),
        ("License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)", "weak"),
        ("Apache-2.0 OR GPL-2.0-only", "permissive"),
    ],
)
def test_strength(text: str, expected: str) -> None:
    assert strength(text) == expected
