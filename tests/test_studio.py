"""`codesign studio`: who is answered, what a tab does, and the page in a headless Chromium."""

import http.client
import json
import threading
import time

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from codesign_jax import cli
from codesign_jax.runs import choice
from codesign_jax.studio import server
from codesign_jax.studio import tab as tabs
from codesign_jax.studio.studio import Studio, about
from codesign_jax.studio.tab import COUNTS, Desk, Tab
from tests.helpers import command_runs
from tests.helpers.browsers import chromium, chromium_launcher  # noqa: F401
from tests.helpers.command_runs import command, own_workplace  # noqa: F401
from tests.helpers.toy_engine import TINY

PAGE = "<script>1 < 2</script>"


@pytest.fixture(scope="module")
def guarded():
    """A server of a page whose WebSocket answers what it is told."""

    def echo(connection):
        try:
            for text in connection:
                connection.send(text)
        except ConnectionClosed:
            pass

    guard = server.Guard(PAGE, everywhere=False)
    with server.listen(guard, echo, "127.0.0.1", 0) as listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield guard.token, listening.socket.getsockname()[1]


def asked(port, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer, answer.read().decode()


def test_a_page_is_served_by_its_token(guarded):
    token, port = guarded
    answer, text = asked(port, f"/?token={token}")
    assert (answer.status, text) == (200, PAGE)
    # By openssl: printf '1 < 2' | openssl dgst -sha256 -binary | base64
    digest = "'sha256-T8Xibs7zV8KTQdRXjpKJTlizX17SudRlddrZKaeFg9E='"
    assert f"script-src {digest};" in answer.headers["Content-Security-Policy"]
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert asked(port, "/", Cookie=cookie.split(";")[0])[0].status == 200
    for path, headers in (
        ("/", {}),
        (f"/?token={token[:-1]}", {}),
        (f"/?token={token}", {"Host": f"stranger.example:{port}"}),
        (f"/?token={token}", {"Host": "127.0.0.1"}),
    ):
        answer, text = asked(port, path, **headers)
        assert answer.status == 403 and PAGE not in text
        assert "Set-Cookie" not in answer.headers
    assert asked(port, f"/../etc/passwd?token={token}")[0].status == 404


def test_a_stranger_s_page_opens_no_socket(guarded):
    """A stranger's page has another origin; cookies alone, which ports share, are not enough."""
    token, port = guarded
    url, own = f"ws://127.0.0.1:{port}/socket", f"http://127.0.0.1:{port}"
    cookie = {"Cookie": f"a=b; codesign-studio-{port}={token}"}
    with connect(url, origin=own, additional_headers=cookie) as socket:
        socket.send("hello")
        assert socket.recv() == "hello"
        with pytest.raises(ConnectionClosed):
            socket.send("x" * (server.MOST_BYTES + 1))
            socket.recv()
    for origin, headers in (
        (own, {}),
        (own, {"Cookie": f"codesign-studio-{port + 1}={token}"}),
        ("http://stranger.example", cookie),
        (f"http://127.0.0.1:{port + 1}", cookie),
        ("null", cookie),
        (None, cookie),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(url, origin=origin, additional_headers=headers)
        assert refused.value.response.status_code == 403


OPTIONS = {"scene": str(TINY), "engine": "mujoco"}


def settled(tab):
    """The messages of a tab that does all there is to do, by kind, the newest one of each."""
    while tab.step():
        pass
    tab.send("end", None)
    return tab.messages()


def show(design, number=1, **changes):
    content = {"number": number, "resting": True, "design": design, "object": 0, "noise": None}
    return json.dumps({"show": content | {"accuracy": "", "trials": COUNTS[0]} | changes})


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """That of a small run."""
    folder = tmp_path_factory.mktemp("studio")
    run = command_runs.copied(folder / "run")
    return Desk(cli.Studio(first=run, out=folder / "saved"))


def test_a_tab_shows_judges_improves_and_saves(desk, capsys, monkeypatch):
    """The verdict is that of `codesign evaluate`; a design of the run is the one in its record."""
    tab, told = Tab(desk), about(desk)
    assert told["groups"] == [
        {"title": "Hand", "members": [0]},
        {"title": "Control", "members": [1]},
    ]
    tab.receive(show([1e9, 30.0], resting=False))
    found = settled(tab)
    assert found["grasp"]["design"] == pytest.approx([180, 30]), "within its bounds"
    assert "verdict" not in found and "overlap" not in found, "not while a slider moves"
    tab.receive(show([100.0, 0.0]))
    found = settled(tab)
    assert found["overlap"].startswith("Deepest overlap: ")
    assert len(found["grasp"]["series"]["height"]) == found["grasp"]["replay"]["frames"]
    design = ["--scene", TINY, "--engine", "mujoco", "--design", "length=100", "arm_z=0"]
    assert command("evaluate", *design, "--trials", COUNTS[0]) == 0
    verdict = capsys.readouterr().out.split("verdict: ")[1].strip()
    assert found["verdict"]["sentence"] == verdict.replace("fresh ", "")
    tab.receive('{"run": [2, 1]}')
    kept = choice.find_grasp(desk.case.scene, desk.record, episode=2, particle=1).design
    found = settled(tab)["grasp"]
    assert found["design"] == pytest.approx(desk.case.space.in_units(kept).tolist(), rel=1e-6)
    monkeypatch.setattr(tabs, "EPISODES", 2)
    monkeypatch.setattr(tabs, "PARTICLES", 4)
    tab.receive(show([60.0, 0.0], number=7))
    settled(tab)
    tab.receive('{"improve": true}')
    found = settled(tab)
    assert found["grasp"]["number"] is None and (found["improving"], found["state"]) == (False, "")
    better = found["grasp"]["design"]
    assert better != [60.0, 0.0] and better == pytest.approx([60.0, 0.0], abs=60), "near it"
    assert len(found["verdict"]["ends"]) == COUNTS[0], "and judged"
    tab.receive(show([100.0, 0.0], number=8))
    settled(tab)
    tab.receive('{"save": true}')
    assert "design-1.toml" in settled(tab)["done"]
    saved = desk.options.out / "design-1.toml"
    assert command("evaluate", "--scene", TINY, "--dry-run", "--design", saved) == 0
    assert "design: length=100 mm arm_z=0 mm" in capsys.readouterr().out


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A studio that is served, and its address."""
    out = tmp_path_factory.mktemp("studio")
    studio = Studio(Desk(cli.Studio(**OPTIONS, out=out)))
    listening, address = studio.listen("127.0.0.1", 0)
    with listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield studio, address
        studio.close()


@pytest.fixture
def page(browser, opened):
    """The page in a browser; what it asks of another machine, and its errors, fail the test."""
    _, address = opened
    page = browser.new_context(viewport={"width": 1200, "height": 800}).new_page()
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    own = address.split("?")[0]
    page.on("request", lambda r: None if r.url.startswith(own) else complaints.append(r.url))
    page.goto(address)
    page.wait_for_selector(COMPLETE)
    yield page
    page.context.close()
    assert complaints == []


COMPLETE = f"#studio .trials button:nth-child({COUNTS[0]}):is(.kept, .lost, .stuck, .failed)"
LENGTH = "#studio input[type=range][aria-label=length]"


def until(true, page):
    """Waits for something that Python asks; the page's policy allows no text to be a program."""
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


@pytest.mark.browser
def test_a_moved_slider_changes_the_verdict_and_the_timeline_plays(page):
    assert page.url.endswith("/"), "no token in the address"
    shown = page.locator("#studio .verdict")
    first = shown.inner_text()
    page.locator(LENGTH).press("Home")  # fingers of 10 mm reach nothing
    until(lambda: "keeps 0 % of 24" in shown.inner_text(), page)
    assert first != shown.inner_text() and page.locator(".trials .lost").count() == 24
    assert page.locator("#studio .tried circle").count() == 2
    page.locator("#studio .tried circle").first.click()  # back to the first design
    until(lambda: shown.inner_text() == first, page)
    view = "document.querySelector('.replay').replay"
    cursor = page.locator(".distance line").last
    at = cursor.get_attribute("x1")
    assert page.evaluate(f"{view}.playing()")
    until(lambda: cursor.get_attribute("x1") != at, page)


@pytest.mark.browser
def test_two_tabs_work_and_a_closed_one_costs_nothing(page, opened, monkeypatch):
    studio, address = opened
    other = page.context.new_page()
    other.goto(address)
    other.wait_for_selector(COMPLETE)
    other.locator(LENGTH).press("Home")
    until(lambda: "keeps 0 %" in other.locator(".verdict").inner_text(), other)
    assert "keeps 0 %" not in page.locator(".verdict").inner_text()
    bench, simulated = studio.desk.bench(""), []
    simulate = bench.outcomes
    monkeypatch.setattr(bench, "outcomes", lambda *a: simulated.append(a) or simulate(*a))
    other.locator("#studio .count").select_option("240")
    until(lambda: simulated, other)
    other.close()
    until(lambda: len(studio.tabs) == 1, page)
    page.wait_for_timeout(200)  # the step that was under way
    done = len(simulated)
    page.wait_for_timeout(300)
    assert len(simulated) == done < 240 / 3 - 8, "it had trials left"
    page.locator("#studio .object").select_option("0")
    assert page.locator(".verdict").inner_text()
