"""A browser that looks at the station."""

import io
import re
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Locator, Page, expect

SOFTWARE_GL = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
KNOWN_ERROR = re.compile("Evaluating a string as JavaScript violates")
"""viser asks at its start whether it may use `eval`; our content security policy says no, it goes on without."""
PATIENCE_MS = 60_000


class Desk:
    """One page, with what every test needs of it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.errors: list[str] = []
        page.on("pageerror", lambda e: self.errors.append(str(e)))

    def open(self, address: str) -> "Desk":
        """Open the station and wait until its controls are there."""
        self.page.goto(address)
        self.page.wait_for_function("() => window.__viserMutable && window.__viserMutable.scene")
        self.page.get_by_text("unglare ·").first.wait_for()
        return self

    def go_home(self) -> "Desk":
        """Go to the list of scans, from wherever the page is."""
        back = self.page.locator("label.ug-back")
        if back.is_visible():
            back.click()
        self.control("Search").fill("")
        self.page.locator("label.ug-scan, .ug-empty").filter(visible=True).first.wait_for()
        return self

    def open_scan(self, name: str) -> "Desk":
        """Open a scan from the list."""
        self.page.locator("label.ug-scan", has_text=name).first.click()
        expect(self.page.locator(".ug-title")).to_have_text(name)
        return self

    def step(self, title: str) -> Locator:
        """Return a step of the stepper."""
        return self.page.locator(".ug-step", has=self.page.get_by_text(title, exact=True))

    def select(self, title: str) -> "Desk":
        """Look at a stage."""
        self.step(title).click()
        expect(self.page.locator(".ug-status-title")).to_contain_text(title)
        return self

    @property
    def state(self) -> Locator:
        """The word for the state of the stage on the screen."""
        return self.page.locator(".ug-status .ug-state")

    @property
    def sentence(self) -> Locator:
        """What the stage on the screen says."""
        return self.page.locator(".ug-status .ug-sentence")

    def button(self, name: str) -> Locator:
        """Return a button by its words."""
        return self.page.get_by_role("button", name=name, exact=True)

    def control(self, label: str) -> Locator:
        """Return the input that stands beside a label: viser ties only some of them together."""
        rows = self.page.locator("div:has(> div > p > label)", has_text=label)
        row = rows.filter(visible=True).last
        return row.locator("input, textarea").last

    def choose(self, label: str, option: str) -> None:
        """Choose from a menu."""
        rows = self.page.locator("div:has(> div > p > label)", has_text=label)
        rows.filter(visible=True).last.locator("input:not([type=hidden])").click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def points(self) -> int:
        """Count the points in the scene."""
        script = "() => {let k = 0; window.__viserMutable.scene.traverse(o => {if (o.isPoints) k += o.geometry.attributes.position.count}); return k}"
        return int(self.page.evaluate(script))

    def wait_for_points(self, least: int) -> None:
        """Wait until the scene has so many points."""
        self.page.wait_for_function(
            "(n) => {let k = 0; window.__viserMutable.scene.traverse(o => {if (o.isPoints) k += o.geometry.attributes.position.count}); return k >= n}",
            arg=least,
        )

    def settle(self, frames: int = 2) -> None:
        """Wait for more frames: viser draws on demand, and once a second."""
        count = "() => window.__viserTestpoints.rendererInfo.render.frame"
        wanted = self.page.evaluate(count) + frames
        self.page.wait_for_function(f"(n) => ({count})() >= n", arg=wanted)

    def colourful(self, above: int = 90) -> float:
        """Return the share of the 3D canvas that has a strong colour; a screenshot, its buffer isn't kept."""
        png = self.page.locator("canvas[data-engine]").screenshot()
        picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
        return float(((picture.max(-1) - picture.min(-1)) > above).mean())

    def camera(self) -> Any:
        """Return where the viewer is."""
        return self.page.evaluate("() => window.__viserMutable.camera.position.toArray()")

    def drag(self, handle: Locator, by_px: float) -> None:
        """Drag something sideways."""
        handle.scroll_into_view_if_needed()
        box = handle.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + by_px, y, steps=5)
        self.page.mouse.up()

    def defects(self) -> list[str]:
        """Return the page's errors, but the one that viser makes on purpose."""
        return [e for e in self.errors if not KNOWN_ERROR.search(e)]
