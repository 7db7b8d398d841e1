"""The report in a real browser: headless Chromium, driven through its ChromeDriver."""

import io
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from jaxfuzzy import page, report
from synthetic import empty_scene, make_scene

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--hide-scrollbars"),
    # WebGL without a graphics card
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
WAIT_S = 60


@pytest.fixture(scope="module")
def written():
    """The page of the scene, without figures: other tests draw those."""
    scene = make_scene()
    dot = b"\x89PNG"  # no picture is needed here, only its place on the page
    return page.html(scene, report.to_dict(scene), {"figures/vrc.png": dot, "figures/overlay.png": dot})


@pytest.fixture(scope="module")
def address(written, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(written, encoding="utf-8")
    return file.as_uri()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Starts browsers, one a set of flags; they are kept for the whole module, since starting takes seconds."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no Chromium with ChromeDriver here (Debian: apt-get install chromium chromium-driver)")
    started = {}

    def start(*flags, phone=False):
        if (flags, phone) not in started:
            options = webdriver.ChromeOptions()
            options.binary_location = binary
            profile = tmp_path_factory.mktemp("profile")
            for flag in (*FLAGS, f"--user-data-dir={profile}", "--window-size=1280,1000", *flags):
                options.add_argument(flag)
            if phone:
                metrics = {"width": 390, "height": 844, "pixelRatio": 2.0, "touch": True}
                options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
            options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
            service = webdriver.ChromeService(driver)
            started[flags, phone] = webdriver.Chrome(options=options, service=service)
        return started[flags, phone]

    yield start
    for one in started.values():
        one.quit()


def opened(one, address):
    one.get(address)
    wait(one, lambda: "Drag" in one.find_element("id", "viewer-status").text)
    return one


def wait(one, condition):
    from selenium.webdriver.support.wait import WebDriverWait

    WebDriverWait(one, WAIT_S).until(lambda _: condition())


def chosen(one):
    return [e.text for e in one.find_elements("css selector", "section.object.selected h3")]


def errors(one):
    return [entry for entry in one.get_log("browser") if entry["level"] == "SEVERE"]


def picture(one):
    from matplotlib.image import imread

    return imread(io.BytesIO(one.find_element("css selector", "#viewer iframe").screenshot_as_png))[..., :3]


def press_shape(one, name, *, touch=False):
    """Clicks or taps on the middle of a shape in the 3D view.

    Through the browser itself: ChromeDriver's own mouse misses what is inside a frame of a page that is scrolled.
    """
    frame = one.find_element("css selector", "#viewer iframe")
    corner = one.execute_script(
        "arguments[0].scrollIntoView({block: 'center'}); const b = arguments[0].getBoundingClientRect(); return [b.x, b.y]",
        frame,
    )
    one.switch_to.frame(frame)
    place = one.execute_async_script(
        """const [name, done] = arguments;
        K3DInstance.then(view => {
            const world = view.getWorld();
            const found = Object.values(world.ObjectsListJson).find(json => json.name === name);
            const mesh = view.getObjectById(found.id);
            mesh.geometry.computeBoundingSphere();
            const middle = mesh.geometry.boundingSphere.center.clone().applyMatrix4(mesh.matrixWorld);
            middle.project(world.camera);
            const box = world.renderer.domElement.getBoundingClientRect();
            done([box.x + (1 + middle.x) * box.width / 2, box.y + (1 - middle.y) * box.height / 2]);
        });""",
        name,
    )
    one.switch_to.default_content()
    at = {"x": corner[0] + place[0], "y": corner[1] + place[1]}
    if touch:
        one.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [at]})
        one.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        return
    for kind, button in (("mouseMoved", "none"), ("mousePressed", "left"), ("mouseReleased", "left")):
        event = {"type": kind, "button": button, "clickCount": 1}
        one.execute_cdp_cmd("Input.dispatchMouseEvent", event | at)


def test_page_is_self_contained(written):
    outside = re.findall(r"""(?:src|href)=["'](?!data:|#)([^"']+)""", written.split("<iframe")[0])
    assert not outside
    assert "{{" not in written.replace("{{}}", "").split("<iframe")[0]
    assert written.count("<figure ") == 1  # the photograph with outlines stands on the page already
    # 1.5 MB of it is the 3D library; the demo's figures and points add less than twice that.
    assert len(written) < 3e6


def test_page_without_photograph_or_objects():
    bare = empty_scene()
    text = page.html(bare, report.to_dict(bare), {})
    assert "0 objects found" in text
    assert 'id="photograph"' not in text


def test_text_from_outside_is_escaped():
    import dataclasses

    scene = dataclasses.replace(make_scene(), settings={"left": "<script>alert(1)</script>"})
    assert "<script>alert(1)" not in page.html(scene, report.to_dict(scene), {})


def test_objects_are_listed_and_chosen(browser, address):
    from selenium.webdriver import Keys

    one = opened(browser(), address)
    rows = one.find_elements("css selector", "#objects tbody tr")
    assert [row.find_element("tag name", "button").text for row in rows] == [
        "0 cone", "1 box", "2 cylinder", "3 sphere", "4 cone",
    ]  # fmt: skip
    assert "radius 70.0 ± 2.0 mm" in rows[3].text
    assert chosen(one) == []

    rows[3].find_element("tag name", "button").click()
    assert chosen(one) == ["Object 3: sphere"]
    detail = one.find_element("css selector", "section.selected").text
    assert "286 (90 %)" in detail
    assert "cylinder 5" in detail
    assert rows[3].find_element("tag name", "button").get_attribute("aria-pressed") == "true"

    shape = one.find_element("css selector", "svg .shape[data-object='1']")
    shape.send_keys(Keys.ENTER)
    assert chosen(one) == ["Object 1: box"]
    one.execute_script("document.querySelector(\"svg .shape[data-object='4']\").dispatchEvent(new Event('click'))")
    assert chosen(one) == ["Object 4: cone"]

    for shape, name in (("1 box", "Object 1: box"), ("2 cylinder", "Object 2: cylinder")):
        press_shape(one, shape)
        wait(one, lambda name=name: chosen(one) == [name])
    assert errors(one) == []


def test_the_3d_view_shows_and_obeys(browser, address):
    from selenium.webdriver import ActionChains

    one = opened(browser(), address)
    seen = picture(one)
    # Reds, yellows, greens and blues of the shapes, on white: many pixels far from grey.
    colorful = (seen.max(-1) - seen.min(-1) > 0.2).mean()
    assert colorful > 0.01
    assert seen.std() > 0.03

    def after(action):
        before = picture(one)
        action()
        wait(one, lambda: np.abs(picture(one) - before).max() > 0.2)
        return picture(one)

    def press(selector):
        return lambda: one.find_element("css selector", f".tools {selector}").click()

    after(press("[data-view='above']"))
    after(press("[data-turn]"))
    after(press("[data-zoom]"))
    after(press("[data-view='front']"))
    hidden = after(press("[data-show='models']"))
    assert (hidden.max(-1) - hidden.min(-1) > 0.2).mean() < colorful
    empty = after(press("[data-show='cloud']"))
    assert empty.std() < 0.01
    after(press("[data-show='models']"))

    def drag():
        frame = one.find_element("css selector", "#viewer iframe")
        ActionChains(one).move_to_element(frame).click_and_hold().move_by_offset(80, 10).release().perform()

    after(drag)
    assert chosen(one) == []  # turning is not choosing
    assert errors(one) == []


@pytest.mark.parametrize("phone", [False, True])
def test_light_and_dark_desk_and_phone(browser, address, phone):
    one = opened(browser(phone=phone), address)
    for scheme, low, high in (("light", 0.9, 1.0), ("dark", 0.0, 0.15)):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        one.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        paper = one.execute_script("return getComputedStyle(document.body).backgroundColor")
        tones = [int(v) / 255 for v in re.findall(r"\d+", paper)[:3]]
        assert low <= min(tones) <= max(tones) <= high
        wait(one, lambda low=low, high=high: low - 0.01 <= np.median(picture(one)[:20]) <= high)
        ink = one.execute_script("return getComputedStyle(document.body).color")
        assert contrast(tones, [int(v) / 255 for v in re.findall(r"\d+", ink)[:3]]) > 7
        soft = one.execute_script("return getComputedStyle(document.querySelector('.soft')).color")
        assert contrast(tones, [int(v) / 255 for v in re.findall(r"\d+", soft)[:3]]) > 4.5
    opened(one, address)  # dark from the start this time, not by a change
    wait(one, lambda: np.median(picture(one)[:20]) <= 0.15)
    width = one.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    assert width[0] <= width[1], "the page must not scroll sideways"
    if phone:
        small = one.execute_script(
            "return [...document.querySelectorAll('button')].filter(b => b.getBoundingClientRect().height < 32).length"
        )
        assert small == 0
        press_shape(one, "2 cylinder", touch=True)
        wait(one, lambda: chosen(one) == ["Object 2: cylinder"])
    assert errors(one) == []


def contrast(one, other):
    """Ratio of luminances as the Web Content Accessibility Guidelines 2.1 define it."""
    lights = []
    for tones in (one, other):
        r, g, b = (t / 12.92 if t <= 0.04045 else ((t + 0.055) / 1.055) ** 2.4 for t in tones)
        lights.append(0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05)
    return max(lights) / min(lights)


def test_a_screen_reader_finds_its_way(browser, address):
    one = opened(browser(), address)
    tree = one.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    named = {(n["role"]["value"], n.get("name", {}).get("value", "")) for n in tree if "role" in n}
    for expected in (
        ("heading", "5 objects found"),
        ("heading", "Objects"),
        ("button", "0 cone"),
        ("button", "object 1 box"),
        ("button", "Turn left"),
        ("rowheader", "0 cone"),
        ("image", "Variance ratio over the number of clusters, and the paper's choice (figure 7)"),
    ):
        assert expected in named, sorted(named)
    assert one.execute_script("return document.documentElement.lang") == "en"
    unnamed = [n for n in tree if n.get("role", {}).get("value") == "button" and not n.get("name", {}).get("value")]
    assert not unnamed


def test_without_webgl_the_rest_works(browser, address):
    one = browser("--disable-3d-apis")
    one.get(address)
    one.find_element("css selector", "#objects tbody button").click()
    assert chosen(one) == ["Object 0: cone"]
    wait(one, lambda: "could not start: it needs WebGL" in one.find_element("id", "viewer-status").text)


def test_picture_file_names_are_known():
    from jaxfuzzy.plot import FIGURES

    assert set(page.LEFT_OUT) < set(FIGURES)
    assert Path(page.DATA / "report.html").is_file()
