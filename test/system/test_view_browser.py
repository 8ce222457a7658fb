"""The view in a real browser: what a person clicks, with a mouse and with keys."""

import asyncio
import dataclasses
import os
import shutil
import threading

import pytest
from unit.cli import missions

from uw_dslam_ros2.view.queue_source import QueueSource
from uw_dslam_ros2.view.server import ViewServer

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HOSTILE = "<b>auv_4</b><img src=x onerror=alert(1)>"
MISSING = (
    f"no browser: none of {', '.join(BROWSERS)} is installed, so the view's page is not tested"
)


@pytest.fixture(scope="module")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        if os.environ.get("CI"):
            pytest.fail(MISSING)
        pytest.skip(MISSING)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        # Containers run as root, where the browser's own sandbox does not start.
        made = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield made
        made.close()


@pytest.fixture(scope="module")
def address():
    """A view of four vehicles, two of them merged, served from a thread."""
    queue = missions.settled_queue()
    queue.add_submap(dataclasses.replace(missions.submap("auv_3"), vehicle_id=HOSTILE))
    server = ViewServer(QueueSource("a harbour", queue))
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    def run(work):
        return asyncio.run_coroutine_threadsafe(work, loop).result(60)

    yield run(server.start())
    run(server.stop())
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)
    loop.close()


@pytest.fixture(params=[(1280, 800), (390, 844)], ids=["desk", "phone"])
def page(browser, address, request):
    """The page, loaded; no error may have been written to its console in the end."""
    errors, others = [], []
    made = browser.new_page(viewport=dict(zip(("width", "height"), request.param, strict=True)))
    made.on("pageerror", lambda error: errors.append(str(error)))
    made.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    made.on("request", lambda r: others.append(r.url) if not r.url.startswith(address) else None)
    made.goto(address)
    made.get_by_text("2 of 4 vehicles merged").wait_for()
    yield made
    made.close()
    assert errors == []
    assert [url for url in others if not url.startswith("data:")] == []


def test_the_map_is_drawn_and_follows_zoom_and_drag(page):
    page.locator("img.leaflet-tile-loaded").first.wait_for()
    scale = page.locator(".leaflet-control-scale-line")
    before = scale.inner_text()
    page.get_by_role("button", name="Zoom in").click()
    page.get_by_role("button", name="Zoom in").click()
    scale.filter(has_not_text=before).wait_for()
    # While it still zooms it cannot be dragged.
    page.locator(".leaflet-zoom-anim").wait_for(state="detached")
    pane = page.locator(".leaflet-map-pane")
    at_first = pane.get_attribute("style")
    box = page.locator("#map").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y - 40, steps=5)
    page.mouse.up()
    assert pane.get_attribute("style") != at_first
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_names_are_text_and_never_markup(page):
    page.get_by_text(HOSTILE, exact=True).first.wait_for()
    assert page.locator("#content b b").count() == 0


def test_a_match_can_be_looked_into(page):
    page.get_by_role("tab", name="Matches").click()
    page.locator("button.card", has_text="ACCEPTED").or_(
        page.locator("button.card", has_text="holds")
    ).first.click()
    dialog = page.get_by_role("dialog")
    picture = dialog.locator("#pair-stage img")
    picture.wait_for()
    assert "agreement" in picture.get_attribute("src")
    dialog.get_by_label("slider").check()
    assert picture.count() == 2
    dialog.locator("#pair-slider").fill("20")
    assert "80%" in picture.last.evaluate("image => image.style.clipPath")
    dialog.get_by_text("probability that it is right").wait_for()
    dialog.get_by_role("button", name="look for rivals").click()
    dialog.get_by_text("There are no rivals").or_(
        dialog.get_by_text("the answer")
    ).first.wait_for()
    page.keyboard.press("Escape")
    dialog.wait_for(state="hidden")


def test_time_goes_back_by_the_keys(page):
    slider = page.get_by_label("time")
    slider.focus()
    page.keyboard.press("Home")
    page.get_by_text("before the first submap").wait_for()
    page.keyboard.press("ArrowRight")
    page.get_by_text("1 of 4 submaps").wait_for()


def test_tabs_are_reached_by_the_keys(page):
    page.get_by_role("tab", name="Vehicles").focus()
    page.keyboard.press("ArrowRight")
    assert page.get_by_role("tab", name="Matches").get_attribute("aria-selected") == "true"


def test_a_cell_says_who_saw_it(page):
    page.locator("img.leaflet-tile-loaded").first.wait_for()
    box = page.locator("#map").bounding_box()
    # One of these places lies in the map; the others say that nothing was seen there.
    for share in (0.5, 0.35, 0.2):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
        page.get_by_role("tab", name="Cell", selected=True).wait_for()
        found = page.get_by_text("submaps say wall")
        found.or_(page.get_by_text("Nothing was seen here.")).wait_for()
        if found.count():
            return
    pytest.fail("no place of the map tells of itself")
