"""Which cameras are there: known addresses one by one, or whatever answers, on an operator's request only.

Asking an address sends it one datagram (GigE Vision's discovery by unicast). Searching lets every driver look for
itself, and GigE Vision drivers do that by broadcast: every device on every network of this machine hears it.
"""

import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from backend.devices.driver_loading import CAMERAS, available_drivers, load_factory
from backend.devices.drivers import gige_link
from backend.devices.errors import RigConfigError
from backend.devices.found import FoundCamera
from backend.devices.options import is_single_address
from backend.devices.peers.gvcp import Bootstrap, Status, ask, read_register
from backend.devices.rig_file import RigFile
from backend.devices.rig_shelf import RigShelf
from backend.domain.errors import InvalidSettingError, UnglareError

_DRIVER_BY_ADDRESS = "aravis"
"""Opens any vendor's GigE Vision camera by its address alone."""


@dataclass(frozen=True)
class SearchResult:
    """What a search found, and why some drivers couldn't search."""

    cameras: tuple[FoundCamera, ...]
    problems: tuple[str, ...] = ()


def ask_addresses(addresses: Sequence[str], timeout_s: float = 0.5) -> tuple[FoundCamera, ...]:
    """Ask addresses, and nobody else, whether a GigE Vision camera is there.

    Parameters
    ----------
    addresses
        IPv4 addresses; one that doesn't answer is left out.
    timeout_s
        How long to wait for the slowest, in [s].

    Raises
    ------
    InvalidSettingError
        If one is no address of a single device; then none is asked.
    """
    for address in addresses:
        _refuse_no_address(address)
    return tuple(
        FoundCamera(
            _DRIVER_BY_ADDRESS,
            {"address": found.address},
            vendor=found.vendor,
            model=found.model,
            serial=found.serial,
            address=found.address,
            controlled_by=controller_of(found.address, timeout_s),
        )
        for found in ask(addresses, timeout_s=timeout_s)
    )


def controller_of(address: str, timeout_s: float = 0.5) -> str | None:
    """Ask a GigE Vision camera who controls it: empty if nobody does, None if it doesn't say.

    Asked by unicast; whoever controls it isn't disturbed.
    """
    control = read_register(address, Bootstrap.CONTROL, timeout_s=timeout_s)
    if control is Status.ACCESS_DENIED:
        return "another program, exclusively"
    if control is None or isinstance(control, Status):
        return None
    if control == 0:
        return ""
    # The register that tells the controller is optional.
    client = read_register(address, Bootstrap.CONTROLLER_ADDRESS, timeout_s=timeout_s)
    if client is None or isinstance(client, Status) or client == 0:
        return "another program"
    return f"a program at {socket.inet_ntoa(client.to_bytes(4))}"


def known_addresses(shelf: RigShelf) -> Mapping[str, tuple[str, ...]]:
    """Return the addresses that rig files name, with rig and camera; a file that can't be read names none."""
    places: dict[str, tuple[str, ...]] = {}
    for kept in shelf.kept():
        try:
            file = RigFile.read(kept.path)
        except RigConfigError:
            continue  # its rig says why when it is opened or listed
        for camera, entry in file.cameras.items():
            address = str((entry.model_extra or {}).get("address") or "")
            if is_single_address(address):
                places[address] = (*places.get(address, ()), f"{kept.name}: {camera}")
    return places


def ask_known(
    shelf: RigShelf, addresses: Sequence[str] = (), timeout_s: float = 0.5
) -> tuple[FoundCamera, ...]:
    """Ask addresses, or without any those that rig files name; say of each camera which rigs use it.

    Raises
    ------
    InvalidSettingError
        If one is no address of a single device.
    """
    places = known_addresses(shelf)
    found = ask_addresses(list(addresses or places), timeout_s)
    return tuple(replace(camera, used_in=places.get(camera.address, ())) for camera in found)


def why_silent(address: str) -> str:
    """Say that no camera answers at an address, and what to do about it: half a sentence more where it can't be reached."""
    elsewhere = gige_link.wrong_network(address, gige_link.content_of(gige_link.ROUTES))
    return f"no camera answers at {address}; {elsewhere or 'check cable, power and the address'}"


def search(drivers: Sequence[str] | None = None) -> SearchResult:
    """Let drivers look for cameras. This may broadcast: call it only when an operator asks for it.

    Parameters
    ----------
    drivers
        Names of drivers; None: all there are. One that can't search at all finds nothing.
    """
    cameras: list[FoundCamera] = []
    problems: list[str] = []
    for driver in available_drivers(CAMERAS) if drivers is None else drivers:
        try:
            cameras += _searched(driver)
        except UnglareError as error:
            problems.append(error.sentence)
    return SearchResult(tuple(map(_with_controller, cameras)), tuple(problems))


def _searched(driver: str) -> Sequence[FoundCamera]:
    look: Callable[[], Sequence[FoundCamera]] | None
    look = getattr(load_factory(CAMERAS, "search", driver), "search", None)
    try:
        return look() if look is not None else ()
    except UnglareError:
        raise
    except Exception as error:
        # A third party's driver may raise anything; the others still search.
        raise RigConfigError(
            f"{driver}: searching failed with {type(error).__name__}: {error}; name the camera in the rig's file"
        ) from error


def _with_controller(camera: FoundCamera) -> FoundCamera:
    if not camera.address or camera.controlled_by is not None:
        return camera
    return replace(camera, controlled_by=controller_of(camera.address))


def _refuse_no_address(address: str) -> None:
    if not is_single_address(address):
        raise InvalidSettingError(
            f"{address!r} is no single device's IPv4 address; write four numbers, e.g. 192.168.10.2"
        )
