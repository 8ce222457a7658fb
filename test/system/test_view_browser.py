"""The view in a real browser: what a person clicks, with a mouse and with keys."""

import asyncio
import contextlib
import dataclasses
import math
import os
import shutil
import threading
import types

import pytest
from unit.cli import missions

from uw_dslam_ros2.view import registering
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


@contextlib.contextmanager
def served(source):
    """The address of a view, served from a thread."""
    server = ViewServer(source)
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    def run(work):
        return asyncio.run_coroutine_threadsafe(work, loop).result(60)

    try:
        yield run(server.start())
    finally:
        run(server.stop())
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10)
        loop.close()


@pytest.fixture(scope="module")
def address():
    """A view of four vehicles, two of them merged."""
    queue = missions.settled_queue()
    queue.add_submap(dataclasses.replace(missions.submap("auv_3"), vehicle_id=HOSTILE))
    with served(QueueSource("a harbour", queue)) as url:
        yield url


@contextlib.contextmanager
def opened(browser, address, size):
    """A page, loaded; no error may have been written to its console in the end."""
    errors, others = [], []
    made = browser.new_page(viewport=dict(zip(("width", "height"), size, strict=True)))
    made.on("pageerror", lambda error: errors.append(str(error)))
    made.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    made.on("request", lambda r: others.append(r.url) if not r.url.startswith(address) else None)
    made.goto(address)
    made.get_by_text(" vehicles merged").wait_for()
    yield made
    made.close()
    assert errors == []
    assert [url for url in others if not url.startswith("data:")] == []


# Shows the middle of what auv_1 went, where it saw something; and where on the screen that is.
OWN_PLACE = """() => {
    const map = window.uwView.map;
    const own = window.uwView.scene.vehicles.find((v) => v.name === "auv_1");
    const piece = own.track[0].xy;
    const [x, y] = piece[piece.length >> 1];
    map.setView([y, x], 4, { animate: false });
    const box = map.getContainer().getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
}"""

SIZES = pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desk", "phone"])


@pytest.fixture(params=[(1280, 800), (390, 844)], ids=["desk", "phone"])
def page(browser, address, request):
    """The page of a view that nobody changes."""
    with opened(browser, address, request.param) as made:
        yield made


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


def test_time_plays_by_itself_to_the_newest_and_stops_there(page):
    page.evaluate(
        """() => {
            const told = document.getElementById("moment-text");
            window.told = [];
            const note = () => window.told.push(told.textContent);
            new MutationObserver(note).observe(told, { childList: true });
        }"""
    )
    play = page.locator("#play")
    play.click()
    page.wait_for_function("() => window.told.length >= 5")
    assert [text.split(" · ")[-1] for text in page.evaluate("window.told")] == [
        "before the first submap",
        *(f"{number} of 4 submaps" for number in range(1, 5)),
    ]
    assert play.get_attribute("aria-label") == "Play"


def test_a_cell_is_told_where_the_mouse_rests_and_by_the_keys(page):
    x, y = page.evaluate(OWN_PLACE)
    page.mouse.move(x - 3, y)
    page.mouse.move(x, y)
    page.locator(".map-note", has_text="free: auv_1/0").wait_for()
    page.locator("#map").focus()
    page.keyboard.press("Enter")
    page.get_by_role("tab", name="Cell", selected=True).wait_for()
    page.get_by_text("submaps say wall").wait_for()


def test_lines_of_matches_are_explained(page):
    layers = page.locator(".layers")
    if layers.get_attribute("open") is None:
        layers.locator("summary").click()
    layers.get_by_text("holds", exact=True).wait_for()
    layers.get_by_label("matches").uncheck()
    assert page.evaluate("!window.uwView.map.hasLayer(window.uwView.groups.constraints)")


def test_tabs_are_reached_by_the_keys(page):
    page.get_by_role("tab", name="Vehicles").focus()
    page.keyboard.press("ArrowRight")
    assert page.get_by_role("tab", name="Matches").get_attribute("aria-selected") == "true"


def test_a_cell_says_who_saw_it(page):
    page.locator("img.leaflet-tile-loaded").first.wait_for()
    page.mouse.click(*page.evaluate(OWN_PLACE))
    page.get_by_role("tab", name="Cell", selected=True).wait_for()
    page.get_by_text("submaps say wall").wait_for()
    page.locator("#content").get_by_text("auv_1/0").wait_for()
    # Far from all maps.
    page.evaluate("window.uwView.map.setView([1000, 1000], 4, { animate: false })")
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.get_by_text("Nothing was seen here.").wait_for()


@pytest.fixture
def deciding(browser, monkeypatch):
    """``with deciding(size) as (page, source)``: of three vehicles two are merged."""

    def known(_source, _target, prior):
        # Found where a person laid the maps, and nowhere else.
        answer = missions.answer(
            types.SimpleNamespace(source_reference=("auv_2",), target_reference=("auv_1",))
        )
        if prior is None:
            return dataclasses.replace(answer, verdict=missions.Verdict.IMPROBABLE)
        return dataclasses.replace(answer, T_target_source=prior.T_target_source)

    monkeypatch.setattr(registering, "register_by_engine", known)

    @contextlib.contextmanager
    def run(size):
        source = QueueSource("a harbour", missions.settled_queue())
        with served(source) as url, opened(browser, url, size) as page:
            page.get_by_label("decided by").fill("Ann <b>")
            yield page, source

    return run


def tab(page, name):
    page.get_by_role("tab", name=name).click()


def shot(page, name, size):
    """A picture for people to look at, where one is wanted."""
    if folder := os.environ.get("UW_SCREENSHOTS"):
        page.screenshot(path=f"{folder}/{name}-{size[0]}.png")


@SIZES
def test_a_constraint_is_clicked_forbidden_and_that_is_undone(deciding, size):
    with deciding(size) as (page, source):
        edge = next(e for e in source.showing().scene()["constraints"] if e["kind"] != "odometry")
        # The middle of its line, as the map's own scale and place have it.
        at = page.evaluate(
            """line => {
                const map = window.uwView.map;
                const [[x0, y0], [x1, y1]] = line;
                const p = map.latLngToContainerPoint([(y0 + y1) / 2, (x0 + x1) / 2]);
                const box = map.getContainer().getBoundingClientRect();
                return [box.x + p.x, box.y + p.y];
            }""",
            edge["line"],
        )
        page.mouse.click(*at)
        dialog = page.get_by_role("dialog")
        dialog.locator("#pair-stage img").wait_for()
        shot(page, "pair", size)
        dialog.get_by_role("button", name="forbid this match").click()
        dialog.wait_for(state="hidden")
        page.get_by_text("1 of 3 vehicles merged").wait_for()
        tab(page, "Decisions")
        page.get_by_text("1: auv_2/0 and auv_1/0 are never matched").or_(
            page.get_by_text("1: auv_1/0 and auv_2/0 are never matched")
        ).wait_for()
        page.get_by_text("Ann <b>").wait_for()
        shot(page, "decisions", size)
        page.get_by_role("button", name="undo").click()
        page.get_by_text("2 of 3 vehicles merged").wait_for()
        page.get_by_text("undone by 2").wait_for()


@SIZES
def test_a_submap_is_withdrawn_restored_and_pins_the_frame(deciding, size):
    with deciding(size) as (page, source):
        tab(page, "Submaps")
        card = page.locator(".card", has_text="auv_2/0")
        card.locator("summary").first.click()
        card.get_by_role("button", name="withdraw", exact=True).click()
        card.locator(".chip", has_text="withdrawn").wait_for()
        card.get_by_role("button", name="restore", exact=True).click()
        card.locator(".chip", has_text="merged").wait_for()
        card.get_by_role("button", name="pin the frame here").click()
        page.get_by_text("Decision 3 is noted.").wait_for()
        page.locator(".decided", has_text="⌂").wait_for()
        poses = {s["name"]: s["at"] for s in source.showing().scene()["submaps"]}
        assert poses["auv_2/0"] == [0.0, 0.0, 0.0]


@SIZES
def test_a_refused_match_is_confirmed_and_drawn_as_a_persons(deciding, size):
    with deciding(size) as (page, source):
        tab(page, "Matches")
        page.locator("button.card", has_text="NOT_ENOUGH_OVERLAP").first.click()
        page.get_by_role("button", name="confirm this pose").click()
        page.get_by_text("3 of 3 vehicles merged").wait_for()
        page.locator(".decided", has_text="◆").wait_for()
        shot(page, "confirmed", size)
        kinds = [edge["kind"] for edge in source.showing().scene()["constraints"]]
        assert kinds.count("confirmed") == 1


@SIZES
def test_a_map_is_dragged_turned_by_keys_and_registered_there(deciding, size):
    with deciding(size) as (page, source):
        tab(page, "Decisions")
        page.get_by_role("button", name="lay one map on another").click()
        dialog = page.get_by_role("dialog")
        dialog.get_by_label("the map of").select_option("auv_3")
        dialog.get_by_label("on that of").select_option("auv_1")
        stage = dialog.locator("#lay-stage")
        stage.locator("img").nth(1).wait_for()
        page.wait_for_function(
            "[...document.querySelectorAll('#lay-stage img')].every(i => i.naturalWidth > 0)"
        )
        page.wait_for_function("document.getElementById('lay-x').value === '0.00'")
        box = stage.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 40, y - 20, steps=4)
        page.mouse.up()
        moved = [float(dialog.locator(f"#lay-{name}").input_value()) for name in ("x", "y")]
        assert moved[0] == pytest.approx(2.0 * moved[1], rel=0.05)
        assert moved[0] > 0.5
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Shift+ArrowUp")
        page.keyboard.press("PageUp")
        values = [float(dialog.locator(f"#lay-{n}").input_value()) for n in ("x", "y", "yaw")]
        assert values[2] == pytest.approx(5.0)
        shot(page, "lay", size)
        dialog.get_by_role("button", name="register here").click()
        dialog.wait_for(state="hidden")
        page.get_by_text("3 of 3 vehicles merged").wait_for()
        (edge,) = [
            e
            for e in source.showing().constraints
            if {e.source.vehicle_id, e.target.vehicle_id} == {"auv_1", "auv_3"}
        ]
        assert abs(edge.T_target_source.yaw) == pytest.approx(math.radians(5.0), abs=0.01)
        page.get_by_text("ACCEPTED").wait_for()


@SIZES
def test_nobody_decides_without_a_name(deciding, size):
    with deciding(size) as (page, source):
        page.get_by_label("decided by").fill("")
        page.get_by_role("button", name="withdraw the run").first.click()
        page.get_by_text("Say who decides").wait_for()
        assert source.showing().scene()["decisions"] == []
        page.get_by_label("decided by").fill("Bo")
        page.get_by_role("button", name="withdraw the run").first.click()
        page.get_by_role("button", name="restore the run").wait_for()


@SIZES
def test_a_fix_is_placed_and_the_map_lies_on_earth(deciding, size):
    with deciding(size) as (page, _):
        tab(page, "Submaps")
        card = page.locator(".card", has_text="auv_1/0")
        card.locator("summary").first.click()
        card.get_by_text("fix this place on earth").click()
        for name, value in (
            ("coordinates", "EPSG:32632"), ("x [m]", "512345"), ("y [m]", "5912345"),
            ("turned by [°], if known", "30"),
        ):  # fmt: skip
            card.get_by_label(name).fill(value)
        shot(page, "fix", size)
        card.get_by_role("button", name="place the fix").click()
        tab(page, "Decisions")
        page.get_by_text("The map lies on earth (EPSG:32632)").wait_for()
        page.get_by_text("0.00 m off").wait_for()


@SIZES
def test_nodes_tell_of_themselves_and_of_bytes_on_the_link(deciding, size):
    with deciding(size) as (page, source):
        link = {
            "name": "auv_1/acoustic_link: <i>link</i>", "level": "ok", "age_s": 0.5,
            "message": "3 submaps known", "values": {"sent bytes cells": "1200"},
            "sent_bytes": 1200.0, "bits_per_s": 64.0,
        }  # fmt: skip
        source.status = lambda: {"is_live": True, "notes": [], "diagnostics": [link]}
        page.get_by_role("button", name="withdraw the run").first.click()  # asks for the status
        page.get_by_role("button", name="restore the run").wait_for()
        tab(page, "Health")
        page.get_by_text("64 bit/s").wait_for()
        page.get_by_text("3 submaps known").click()
        page.get_by_text("sent bytes cells").wait_for()
        shot(page, "health", size)
        link["message"] = "4 submaps known"
        page.get_by_text("4 submaps known").wait_for()
        assert page.get_by_text("sent bytes cells").is_visible()  # still open
