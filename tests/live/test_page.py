"""The page in a real Chromium, fed by a real acquisition from the simulated meter."""

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests.live.browser import acquiring, browsing, complaints, requested, resize

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # selenium's connections


@dataclass
class Visit:
    browser: Any
    process: "subprocess.Popen[str]"
    folder: Path

    def run(self, script: str) -> Any:
        return self.browser.execute_script(script)

    def chart(self) -> dict[str, Any]:
        """What the main chart shows: its numbers, and its picture."""
        return self.run(
            "const c = document.getElementById('chart-input');"
            "return {...c.dataset, picture: c.toDataURL(), from: Number(c.dataset.begin), to: Number(c.dataset.end)}"
        )

    def wait(self, condition: Callable[[], Any], seconds: float = 60.0) -> Any:
        deadline = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < deadline, "it never came"
            time.sleep(0.05)
        return found

    def click(self, name: str) -> None:
        self.run(f"document.getElementById('{name}').click()")

    def drag(self, begin: float, end: float) -> None:
        """Drag over the main chart, from one fraction of its width to another, as a mouse does."""
        action_chains = pytest.importorskip("selenium.webdriver").ActionChains
        chart = self.browser.find_element("id", "chart-input")
        width = chart.size["width"]
        chain = action_chains(self.browser, duration=50)
        chain.move_to_element_with_offset(chart, round((begin - 0.5) * width), 0).click_and_hold()
        chain.move_by_offset(round((end - begin) * width / 2), 2).move_by_offset(round((end - begin) * width / 2), 2)
        chain.release().perform()


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visit]:
    folder = tmp_path_factory.mktemp("recordings")
    with browsing() as browser, acquiring(folder) as (url, process):
        browser.get(url)
        here = Visit(browser, process, folder)
        here.wait(lambda: int(here.chart().get("cells", 0)) > 20)
        yield here
        assert complaints(browser) == []
        assert requested(browser) <= {"127.0.0.1"}


def test_the_plots_move(visit: Visit) -> None:
    before = visit.chart()

    after = visit.wait(lambda: (now := visit.chart())["to"] > before["to"] + 500 and now)

    assert after["picture"] != before["picture"]
    for name in ("chart-u", "chart-window", "chart-histogram", "chart-allan"):
        script = (
            f"const c = document.getElementById('{name}');"
            "return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((byte) => byte)"
        )
        assert visit.run(script), name


def test_pause_stops_plots_and_numbers_and_resume_lets_them_go_on(visit: Visit) -> None:
    visit.click("pause")
    held, reading = visit.chart(), visit.run("return document.getElementById('reading').dataset.index")
    time.sleep(1.0)
    later = visit.chart()
    assert (later["to"], later["picture"]) == (held["to"], held["picture"])
    assert visit.run("return document.getElementById('reading').dataset.index") == reading
    assert visit.run("return document.getElementById('state').textContent") == "paused"

    visit.click("pause")

    visit.wait(lambda: visit.chart()["to"] > held["to"])
    assert visit.run("return document.getElementById('state').textContent") == "live"


def test_dragging_across_a_chart_zooms_into_the_past_and_a_click_comes_back(visit: Visit) -> None:
    live = visit.chart()
    visit.drag(0.9, 0.97)
    zoomed = visit.wait(lambda: (now := visit.chart())["to"] - now["from"] < 20_000 and now)

    assert live["from"] < zoomed["from"] < zoomed["to"] < time.time_ns() * 1e-6
    time.sleep(0.5)
    assert visit.chart()["to"] == zoomed["to"], "what is zoomed into stands still"
    visit.click("live")
    visit.wait(lambda: visit.chart()["to"] - visit.chart()["from"] > 50_000)


def test_another_span_is_shown_when_it_is_chosen(visit: Visit) -> None:
    for seconds in ("10", "3600", "60"):
        visit.run(
            f"const s = document.getElementById('span'); s.value = '{seconds}'; s.dispatchEvent(new Event('change'))"
        )
        width = visit.wait(
            lambda seconds=seconds: (
                (now := visit.chart())["to"] - now["from"] == pytest.approx(1e3 * float(seconds)) and now
            )
        )
        assert int(width["cells"]) > 0


@pytest.mark.parametrize(("width", "dark"), [(390, False), (390, True), (1280, True), (1280, False)])
def test_it_fits_a_phone_and_a_desktop_in_the_light_and_in_the_dark(width: int, dark: bool, visit: Visit) -> None:
    resize(visit.browser, width, 844, dark=dark)
    visit.wait(lambda: visit.run("return document.documentElement.clientWidth") == width)
    drawn = int(visit.chart()["drawn"])
    visit.wait(lambda: int(visit.chart()["drawn"]) > drawn + 2)

    assert visit.run("return document.documentElement.scrollWidth") <= width
    ground = visit.run("return getComputedStyle(document.body).backgroundColor")
    assert (int(ground.split("(")[1].split(",")[0]) < 128) == dark
    box = "const b = document.getElementById('{}').getBoundingClientRect(); return [b.left, b.right, b.height]"
    for name in ("estimate", "reading", "pause", "span", "chart-input", "chart-allan"):
        left, right, height = visit.run(box.format(name))
        assert 0 <= left < right <= width, name
        assert height > 15, name


def test_nothing_is_asked_of_another_host_and_the_console_has_no_complaint(visit: Visit) -> None:
    """Of the whole visit so far: no error, no violation of the content policy, no request that leaves."""
    assert complaints(visit.browser) == []
    assert requested(visit.browser) == {"127.0.0.1"}


def test_the_numbers_are_the_recordings_to_the_bit(visit: Visit) -> None:
    """Comes last, for it ends the acquisition."""
    shown = []
    for _ in range(10):
        script = "return ['reading', 'estimate'].map((name) => ({...document.getElementById(name).dataset}))"
        shown.append(visit.run(script))
        time.sleep(0.1)
    cells, bin_ms = visit.run("return [store.readings, store.bin_ms]")
    visit.click("pause")  # or it would complain that nobody answers
    visit.process.send_signal(signal.SIGINT)
    assert visit.process.wait(timeout=60) == 0

    topics: dict[str, dict[int, Any]] = {"/dmm/raw": {}, "/dmm/filtered": {}}
    (path,) = visit.folder.glob("*.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=list(topics)):
            topics[channel.topic][message.sequence] = (message.publish_time, decoded)
    for reading, estimate in shown:
        assert float(reading["valueV"]) == topics["/dmm/raw"][int(reading["index"])][1].value
        filtered = topics["/dmm/filtered"][int(estimate["index"])][1]
        assert float(estimate["valueV"]) == filtered.value
        assert float(estimate["sigmaV"]) == filtered.sigma
    binned: dict[int, list[float]] = {}
    for t_ns, decoded in topics["/dmm/raw"].values():
        binned.setdefault(t_ns // round(bin_ms * 1e6), []).append(decoded.value)
    for cell in cells[1:-1]:
        assert (cell["lo"], cell["hi"]) == (min(binned[cell["n"]]), max(binned[cell["n"]]))
    assert len(cells) > 20
