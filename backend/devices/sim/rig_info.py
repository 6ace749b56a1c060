"""Who a simulated rig is."""

from importlib.metadata import PackageNotFoundError, version

from backend.devices.protocols import DeviceInfo


def rig_info(model: str) -> DeviceInfo:
    """Say who built a simulated rig: we did, in this version."""
    try:
        release = version("unglare")
    except PackageNotFoundError:  # run from a source tree
        release = ""
    return DeviceInfo("unglare", model, driver=release, simulated=True)
