"""Tests a report in a browser: `python report_browser.py REPORT.html [SCREENSHOTS]`, run by `report_browser.rs`.

Needs playwright from PyPI and Chromium (`DEMC_CHROMIUM`, or `chromium` on the path). Fails with an assertion.
"""

import os
import shutil
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

PIXELS = """(id) => { const c = document.getElementById(id); const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  let sum = 0; for (let i = 0; i < d.length; i += 4) sum += d[i] + d[i + 1] + d[i + 2]; return sum / (d.length / 4) / 3; }"""


def settle(page: Page, change) -> None:
    """Runs `change` and waits until the viewer has drawn the new state."""
    change()
    page.wait_for_function(
        """() => { const s = document.getElementById('stage'), v = (id) => document.getElementById(id).value;
        const i = [...document.getElementById('strip').children].findIndex((b) => b.getAttribute('aria-pressed') === 'true');
        return s.dataset.drawn === `${i} ${v('left')} ${v('right')} ${v('exposure')}`; }"""
    )


def divider_moves(page: Page) -> None:
    divider, stage = page.locator("#divider"), page.locator("#stage")
    now = lambda: int(divider.get_attribute("aria-valuenow"))
    assert now() == 50
    stage.scroll_into_view_if_needed()
    before = stage.screenshot()
    box = stage.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + box["height"] * 0.5)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + box["height"] * 0.5, steps=4)
    page.mouse.up()
    assert 18 <= now() <= 22, now()
    assert stage.screenshot() != before, "dragging changes pixels"
    divider.focus()
    for key, expected in [("Home", 0), ("ArrowRight", 1), ("PageUp", 11), ("ArrowLeft", 10), ("End", 100)]:
        page.keyboard.press(key)
        assert now() == expected, (key, now())
    dragged = stage.screenshot()
    page.keyboard.press("Home")
    assert stage.screenshot() != dragged, "the keyboard changes pixels"
    for _ in range(5):
        page.keyboard.press("PageUp")
    assert now() == 50


def exposure_changes_pixels(page: Page) -> None:
    settle(page, lambda: page.select_option("#right", "reference"))
    slider = page.locator("#exposure")
    means = {0: page.evaluate(PIXELS, "canvas-right")}
    slider.focus()
    for key, stops in [("End", 3), ("Home", -3)]:
        settle(page, lambda: page.keyboard.press(key))
        means[stops] = page.evaluate(PIXELS, "canvas-right")
    assert means[-3] + 10 < means[0] < means[3] - 10, means
    # At -3 stops nothing below a radiance of 8 is white: there are shades where 1 was clipped.
    settle(page, lambda: page.click("#exposure-reset"))
    assert abs(page.evaluate(PIXELS, "canvas-right") - means[0]) < 1e-9


def layers_change_pixels(page: Page) -> None:
    options = page.locator("#left option").evaluate_all("(list) => list.map((o) => o.value)")
    assert {"noisy", "denoised", "reference", "error:noisy", "error:denoised"} <= set(options), options
    means = set()
    for option in options:
        settle(page, lambda: page.select_option("#left", option))
        means.add(round(page.evaluate(PIXELS, "canvas-left"), 6))
    assert len(means) >= len(options) - 1, (options, means)
    settle(page, lambda: page.select_option("#left", "noisy"))
    first = page.evaluate(PIXELS, "canvas-left")
    page.locator("#strip button").first.focus()
    settle(page, lambda: page.keyboard.press("ArrowRight"))
    assert page.evaluate(PIXELS, "canvas-left") != first, "another image"
    settle(page, lambda: page.locator("#strip button").first.click())


def table_sorts(page: Page) -> None:
    for name in ["relmse", "ssim", "energy-bias"]:
        column = page.evaluate(
            "(name) => [...document.querySelectorAll('#scores thead button')].findIndex((b) => b.firstChild.data === name)", name)
        read = lambda: page.evaluate(
            "(c) => [...document.querySelectorAll('#scores tbody tr')].map((r) => Number(r.children[c].textContent.replace('−', '-')))", column)
        header = page.locator("#scores thead button").nth(column)
        header.focus()
        page.keyboard.press("Enter")
        up = read()
        assert up == sorted(up) and len(set(up)) > 2, (name, up)
        header.click()
        down = read()
        assert down == sorted(up, reverse=True), (name, down)
        assert page.locator("#scores th[aria-sort=descending]").count() == 1
    page.select_option("#filter", label="denoised")
    methods = page.locator("#scores tbody td.text").all_text_contents()
    assert set(methods) == {"denoised"}, methods
    page.select_option("#filter", label="all methods")


def everything_has_a_name(page: Page) -> None:
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('button, select, input, [role=slider], [role=img], canvas, svg')]
        .filter((e) => !(e.getAttribute('aria-label') || e.textContent.trim() || e.getAttribute('aria-hidden') || (e.labels && e.labels.length)))
        .map((e) => e.outerHTML.slice(0, 120))""")
    assert not nameless, nameless


def luminance(page: Page) -> float:
    color = page.evaluate("getComputedStyle(document.body).backgroundColor")
    return sum(float(x) for x in color[4:-1].split(",")[:3])


def main(report: Path, screenshots: Path | None) -> None:
    chromium = os.environ.get("DEMC_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    assert chromium, "no chromium on the path"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for width in [1400, 390]:
            for scheme in ["light", "dark"]:
                page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
                troubles, requests = [], []
                page.on("console", lambda message: message.type == "error" and troubles.append(message.text))
                page.on("pageerror", lambda error: troubles.append(str(error)))
                page.on("request", lambda request: requests.append(request.url))
                settle(page, lambda: page.goto(report.as_uri()))
                assert (luminance(page) < 200) == (scheme == "dark"), scheme
                overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
                assert overflow <= 0, f"{overflow} px too wide at {width}"
                if screenshots:
                    page.screenshot(path=screenshots / f"{width}-{scheme}.png", full_page=True)
                if width == 1400 and scheme == "light":
                    divider_moves(page)
                    exposure_changes_pixels(page)
                    layers_change_pixels(page)
                    table_sorts(page)
                    everything_has_a_name(page)
                assert not troubles, troubles
                outside = [url for url in requests if not url.startswith("data:") and url != report.as_uri()]
                assert not outside, outside
                page.close()
        browser.close()
    print("the report does what it should")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
