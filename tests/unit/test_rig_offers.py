"""Which rigs there are to choose from, and why one can't be used."""

from collections.abc import Iterator

import pytest

from backend.devices import loading
from backend.devices.errors import RigNotFoundError
from backend.services.rig_offers import _settled_offer, offer_rigs


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    _settled_offer.cache_clear()
    yield
    _settled_offer.cache_clear()


def test_the_simulated_rig_is_offered_with_its_options() -> None:
    offer = next(offer for offer in offer_rigs() if offer.name == "simulated")
    assert offer.error is None
    assert {"scene", "size", "seed"} <= set(offer.options_schema["properties"])


def test_a_rig_whose_options_have_a_title_is_offered_under_it() -> None:
    titles = {offer.name: offer.title for offer in offer_rigs()}
    assert titles["simulated"] == "Simulated"
    assert titles["sim-lcd"] == "Simulated screen and mirror"


def test_a_rig_that_cant_be_loaded_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = (loading.RigEntry("acme-rig", "acme 1.0"),)
    monkeypatch.setattr(loading, "available_rigs", lambda: entries)

    def broken(name: str) -> dict[str, object]:
        raise RigNotFoundError(f"rig {name} can't be loaded; check that its package is installed")

    monkeypatch.setattr(loading, "options_schema", broken)
    (offer,) = offer_rigs()
    assert (offer.name, offer.title, offer.doc, offer.options_schema) == (
        "acme-rig", "Acme rig", "acme 1.0", {},
    )  # fmt: skip
    assert offer.error == "rig acme-rig can't be loaded; check that its package is installed"


def test_a_factory_that_doesnt_describe_its_options_takes_any() -> None:
    assert loading.options_schema("builtins:dict") == {}
