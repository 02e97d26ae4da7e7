"""`codesign studio`: who is answered, what a tab does, and the page in a headless Chromium."""

import contextlib
import http.client
import importlib.metadata
import itertools
import json
import re
import shlex
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tyro
from rich.console import Console
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import codesign_jax
from codesign_jax import cli
from codesign_jax.commands import common
from codesign_jax.judge.verdict import VERDICTS
from codesign_jax.report import bodies
from codesign_jax.runs import selection
from codesign_jax.scene.schema import InputError
from codesign_jax.studio import process, server
from codesign_jax.studio import studio as studios
from codesign_jax.studio import tab as tabs
from codesign_jax.studio.desk import COUNTS, Bench, Desk
from codesign_jax.studio.studio import Studio, about
from codesign_jax.studio.tab import Tab
from tests.helpers import command_runs
from tests.helpers.browsers import chromium, chromium_launcher, spot_of  # noqa: F401
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


def get(port, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True)  # and no check of the path
        for name, value in ({"Host": f"127.0.0.1:{port}"} | headers).items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer, answer.read().decode() if answer.status != 101 else ""


def test_a_page_is_served_by_its_token(guarded):
    token, port = guarded
    answer, text = get(port, f"/?token={token}")
    assert (answer.status, text) == (200, PAGE)
    # By openssl: printf '1 < 2' | openssl dgst -sha256 -binary | base64
    digest = "'sha256-T8Xibs7zV8KTQdRXjpKJTlizX17SudRlddrZKaeFg9E='"
    assert f"script-src {digest};" in answer.headers["Content-Security-Policy"]
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert "Path" not in cookie, "behind a proxy it is sent to this page's path alone"
    assert get(port, "/", Cookie=cookie.split(";")[0])[0].status == 200
    for path, headers in (
        ("/", {}),
        (f"/?token={token[:-1]}", {}),
        (f"/?token={token}", {"Host": f"stranger.example:{port}"}),
        (f"/?token={token}", {"Host": f"127.0.0.1.stranger.example:{port}"}),
        (f"/?token={token}", {"Host": f"localhost:{port}@stranger.example"}),
        (f"/?token={token}", {"Host": "localhost:x"}),
    ):
        answer, text = get(port, path, **headers)
        assert answer.status == 403 and PAGE not in text
        assert "Set-Cookie" not in answer.headers
        if "Host" in headers:
            assert f"ssh -L {port}:localhost:{port} HOST" in text, "what to do"
    for path in ("/../etc/passwd", "/user/me/proxy/8791/"):
        answer, text = get(port, f"{path}?token={token}")
        assert answer.status == 404 and f"ssh -L {port}" in text


def test_a_tunnel_may_have_another_port(guarded):
    """Its page has a cookie of that port: tunnels to two machines may end at one port there."""
    token, port = guarded
    hosts = {"localhost:9000": 9000, "127.0.0.1:1": 1, "[::1]:65535": 65535, "LOCALHOST": 80}
    for host, cookie_port in hosts.items():
        answer, _ = get(port, f"/?token={token}", Host=host)
        cookie = answer.headers["Set-Cookie"].split(";")[0]
        assert (answer.status, cookie) == (200, f"codesign-studio-{cookie_port}={token}")
        opening = {"Connection": "Upgrade", "Upgrade": "websocket", "Host": host}
        opening |= {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
        for origin, status in (
            (f"http://{host}", 101),
            (f"https://{host}", 101),  # a proxy with TLS
            (f"http://localhost:{port}", 403),
            (f"http://stranger.example:{cookie_port}", 403),
            (f"{host}", 403),
        ):
            headers = opening | {"Cookie": cookie, "Origin": origin}
            assert get(port, "/socket", **headers)[0].status == status


def test_odd_requests_are_refused_and_do_not_fail(guarded):
    token, port = guarded
    for method in ("HEAD", "POST", "PUT", "OPTIONS", "TRACE", "get"):
        answer, text = get(port, f"/?token={token}", method)
        assert (answer.status, answer.headers["Allow"], text) == (405, "GET", "")
    for path in (
        f"//[::1?token={token}",
        f"http://[::1?token={token}",
        "/[",
        "*",
        "//",
        "/socket/",
    ):
        assert get(port, path)[0].status == 404
    for query in (
        "token=%ff",
        "token=%00",
        "token=&token=",
        "token",
        "&" * 2000,
        "token=%ED%A0%80",
    ):
        assert get(port, f"/?{query}")[0].status == 403
    for cookie in (f"codesign-studio-{port}=\xff".encode("latin-1"), b"\xff=\xff", b'a="', b";;;="):
        assert get(port, "/", Cookie=cookie)[0].status == 403


def test_a_stranger_s_page_opens_no_socket(guarded):
    """A stranger's page has another origin; cookies alone, which ports share, are not enough."""
    token, port = guarded
    url = f"ws://127.0.0.1:{port}/socket"
    same_origin = f"http://127.0.0.1:{port}"
    cookie = {"Cookie": f"a=b; codesign-studio-{port}={token}"}
    with connect(url, origin=same_origin, additional_headers=cookie) as socket:
        socket.send("hello")
        assert socket.recv() == "hello"
        with pytest.raises(ConnectionClosed):
            socket.send("x" * (server.MOST_BYTES + 1))
            socket.recv()
    for origin, headers in (
        (same_origin, {}),
        (same_origin, {"Cookie": f"codesign-studio-{port + 1}={token}"}),
        ("http://stranger.example", cookie),
        (f"http://127.0.0.1:{port + 1}", cookie),
        ("null", cookie),
        (None, cookie),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(url, origin=origin, additional_headers=headers)
        assert refused.value.response.status_code == 403


def until(true, page=None):
    """Waits for something that Python asks; a page's policy allows no text to be a program."""
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        page.wait_for_timeout(50) if page else time.sleep(0.02)


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


def test_the_studio_begins_with_the_hand_to_build_or_with_what_is_named():
    assert Desk(cli.Studio()).case.scene.name == "build"
    assert Desk(cli.Studio(hand="tripod3")).case.scene.name == "paper"
    assert Desk(cli.Studio(design=(("length=100",),))).case.scene.name == "paper"


@pytest.mark.slow  # 15 s; the same in a browser: make test-browser
def test_a_tab_shows_judges_improves_and_saves(desk, capsys, monkeypatch):
    """The verdict is that of `codesign evaluate`; a design of the run is the one in its record."""
    tab = Tab(desk)
    description = about(desk)
    judged = description["run"]["verdict"]
    assert judged.startswith("The run's verdict") and "steps of 20 ms" in judged
    assert description["groups"] == [
        {"title": "Hand", "members": [0]},
        {"title": "Control", "members": [1]},
    ]
    tab.receive(show([1e9, 30.0], resting=False))
    messages = settled(tab)
    assert messages["grasp"]["design"] == pytest.approx([180, 30]), "within its bounds"
    assert "verdict" not in messages and "overlap" not in messages, "not while a slider moves"
    tab.receive(show([100.0, 0.0]))
    messages = settled(tab)
    assert messages["overlap"].startswith("Deepest overlap: ")
    assert len(messages["grasp"]["series"]["height"]) == messages["grasp"]["replay"]["frames"]
    design = ["--scene", TINY, "--engine", "mujoco", "--design", "length=100", "arm_z=0"]
    assert command("evaluate", *design, "--trials", COUNTS[0]) == 0
    [verdict] = re.findall(r"^verdict: (.*)$", capsys.readouterr().out, re.M)
    sentence, _, causes = messages["verdict"]["sentence"].partition(". Lost: ")
    objects, further = re.search(
        r"grasps of (.*) \(.*\): not enough trials, (.*)", verdict
    ).groups()
    kept = messages["verdict"]["ends"].count(VERDICTS.index("kept"))
    assert sentence == f"{kept} of {COUNTS[0]} grasps kept of {objects}; {further}"
    lost = messages["verdict"]["ends"].count(VERDICTS.index("lost"))
    assert sum(map(int, re.findall(r"\d+", causes))) == lost
    tab.receive('{"run": [2, 1]}')
    kept = selection.find_grasp(desk.case.scene, desk.record, episode=2, particle=1).design
    messages = settled(tab)["grasp"]
    assert messages["design"] == pytest.approx(desk.case.space.in_units(kept).tolist(), rel=1e-6)
    monkeypatch.setattr(tabs, "EPISODES", 2)
    monkeypatch.setattr(tabs, "PARTICLES", 4)
    tab.receive(show([100.0, 0.0], number=7))
    settled(tab)
    tab.receive('{"improve": true}')
    messages = settled(tab)
    assert messages["grasp"]["number"] is None and (messages["improving"], messages["state"]) == (
        False,
        "",
    )
    better = messages["grasp"]["design"]
    assert better == pytest.approx([100.0, 0.0], abs=60), "near it"
    assert np.abs(np.subtract(better, [100.0, 0.0])).min() > 1, "and elsewhere"
    assert len(messages["verdict"]["ends"]) == COUNTS[0], "and judged"
    tab.receive(show([100.0, 0.0], number=8))
    settled(tab)
    tab.receive('{"save": true}')
    told = settled(tab)["done"]
    saved = desk.options.out / "design-1.toml"
    words = shlex.split(told.splitlines()[-1])
    assert words[:3] == ["codesign", "studio", str(saved)], "the command that opens it"
    opened = common.find_case(tyro.cli(cli.COMMANDS, args=words[1:]))
    np.testing.assert_allclose(opened.space.in_units(opened.design), [100.0, 0.0], atol=1e-4)
    assert command("evaluate", "--scene", TINY, "--dry-run", saved) == 0
    assert "design: length=100 mm arm_z=0 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "1e400",
        "[]",
        "{}",
        "[" * 100_000,
        '{"quit": true}',
        '{"run": [Infinity, 0]}',
        '{"run": [NaN, 0]}',
        '{"run": 3}',
        show([0.0, 0.0]).replace('"number": 1', '"number": 1e400'),
        show([0.0, 0.0], number=None),
        show([0.0, 0.0], object=float("inf")),
        show([0.0, 0.0], object=-1),
        show([0.0, 0.0], noise=10**400),
        show([0.0, 0.0], accuracy={}),
        show([0.0, 0.0], trials=[24]),
        show([10**400, 0.0]),
        show([float("nan"), 0.0]),
        show([float("-inf"), 0.0]),
        show([0.0]),
        show("length"),
        b"\xff\xfe",
    ],
)
def test_what_is_no_message_is_answered(desk, text):
    tab = Tab(desk)
    tab.receive(text)
    assert not tab.step()
    messages = tab.messages()
    assert messages["error"] and "grasp" not in messages


def test_choices_are_taken_as_what_they_equal(desk):
    """JSON's true and 1.0 are the 1 that a trial, an object and a number of trials have."""
    tab = Tab(desk)
    tab.receive(show([1e308, -1e308], number=True, object=False, noise=True, trials=24.0))
    assert settled(tab)["grasp"]["design"] == [180.0, -50.0]


def test_a_lost_tab_is_forgotten(desk):
    class Broken:
        def __iter__(self):
            raise RuntimeError

        def send(self, text):
            raise ConnectionClosed(None, None)

    studio = Studio(desk)
    with pytest.raises(RuntimeError):
        studio.serve(Broken())
    assert studio.tabs == []


def test_what_fails_once_works_again(desk, monkeypatch, tmp_path):
    """What is shown stays after an error of writing, and a failed step ends what it was about."""
    place = tmp_path / "saved"
    monkeypatch.setattr(desk.options, "out", place)
    tab = Tab(desk)
    tab.receive('{"save": true}')
    messages = settled(tab)
    assert messages["error"] and "done" not in messages
    tab.receive(show([100.0, 0.0]))
    settled(tab)
    for action in ("save", "page", "export"):
        place.touch()
        tab.receive(json.dumps({action: True}))
        assert str(place) in settled(tab)["error"]
        place.unlink()
    monkeypatch.setattr(tabs.viewer, "write", lambda *a, **k: 1 / 0)
    tab.receive('{"page": true}')
    assert settled(tab)["error"].startswith("ZeroDivisionError: ")
    assert list(place.iterdir()) == [], "and no file of its name"
    tab.receive('{"save": true}')
    assert "saved" in settled(tab)["done"]
    text = (place / "design-1.toml").read_text()
    bench = desk.bench("")
    with monkeypatch.context() as broken:
        broken.setattr(bench, "outcomes", lambda *a: 1 / 0)
        tab.receive(show([90.0, 0.0]))
        assert "ZeroDivisionError" in settled(tab)["error"]
        tab.receive('{"save": true}')
        assert "saved" in settled(tab)["done"], "the grasp is shown, its verdict alone is not"
        broken.setattr(bench, "grasp", lambda *a: 1 / 0)
        tab.receive(show([80.0, 0.0]))
        assert "ZeroDivisionError" in settled(tab)["error"]
        tab.receive('{"save": true}')
        messages = settled(tab)
        assert messages["error"] and "done" not in messages
    tab.receive(show([100.0, 0.0]))
    tab.receive('{"save": true}')
    assert "saved" in settled(tab)["done"]
    assert (place / "design-3.toml").read_text() == text


class Children:
    """Stands in for the processes of commands: each ends when it is told to."""

    def __init__(self, monkeypatch):
        self.lines = []
        self.ends = threading.Semaphore(0)
        monkeypatch.setattr(subprocess, "run", self.run)

    def run(self, line, **_):
        self.lines.append(line)
        assert self.ends.acquire(timeout=60)
        out = Path(line[line.index("--out") + 1]) if "--out" in line else None
        if out and len(self.lines) != 2:  # the second one fails
            (out / "build_sheet.md").touch()
        return subprocess.CompletedProcess(line, 0, "exported: it", "")


def ended(tab):
    """What is told of a command, once it has ended."""
    end = time.monotonic() + 60
    while (text := (tab.messages() or {}).get("done", process.RUNNING)).endswith(process.RUNNING):
        assert time.monotonic() < end
    return text


def test_one_command_runs_at_a_time(desk, monkeypatch, tmp_path):
    """A double click is answered, every export has a folder, and what is shown can be pasted."""
    children = Children(monkeypatch)
    place = tmp_path / "a; $(b) 'c'"
    monkeypatch.setattr(desk.options, "out", place)
    tab = Tab(desk)
    other = Tab(desk)
    for client in (tab, other):
        client.receive(show([100.0, 0.0]))
        settled(client)
    tab.receive('{"export": true}')
    assert settled(tab)["done"].endswith(process.RUNNING)
    for again, action in itertools.product((tab, other), ("export", "report")):
        again.receive(json.dumps({action: True}))
        assert settled(again)["error"] and len(children.lines) <= 1
    children.ends.release()
    line, printed = ended(tab).splitlines()
    assert printed == "exported: it"
    design = place / "design-1.toml"
    folder = place / "export-1"
    expected = ["codesign", "export", design, "--engine", "mujoco", "--out", folder]
    assert shlex.split(line) == [str(word) for word in expected]
    python = [sys.executable, "-P", "-m", "codesign_jax.cli"]
    assert children.lines == [[*python, *shlex.split(line)[1:]]]
    for action in ("export", "export", "report"):
        until(lambda: not process.under_way())
        tab.receive(json.dumps({action: True}))
        settled(tab)
        children.ends.release()
        ended(tab)
    assert children.lines[-1] == [*python, "report", str(desk.options.run_folder)]
    names = [f"design-{k}.toml" for k in (1, 2, 3)] + ["export-1", "export-2"]
    assert sorted(path.name for path in place.iterdir()) == names, "the second one failed"
    until(lambda: not process.under_way())


def test_a_report_needs_a_run(desk, monkeypatch):
    monkeypatch.setattr(desk.options, "run_folder", None)
    tab = Tab(desk)
    tab.receive('{"report": true}')
    assert settled(tab)["error"] and not process.under_way()


def test_a_command_imports_nothing_of_the_working_directory(workplace, monkeypatch):
    """Such as a file beside a stranger's run: Python puts the directory of `-m` first."""
    monkeypatch.setenv("PYTHONPATH", str(Path(codesign_jax.__file__).parents[1]))
    for name in ("rich", "tyro", "colorsys", "codesign_jax"):
        (workplace / f"{name}.py").write_text("open('RAN', 'w')\nraise SystemExit('it ran')")
    lines = []
    process.start(["--version"], lines.append)
    until(lambda: len(lines) == 2)
    until(lambda: not process.under_way())
    assert lines[0] == f"codesign --version{process.RUNNING}"
    assert importlib.metadata.version("codesign-jax") in lines[1]
    assert not (workplace / "RAN").exists()


def test_the_page_is_served_while_the_simulation_is_compiled(desk, monkeypatch, capsys):
    """A tab is told that, and what a command prints, though it was connected later."""
    heard = []

    def warm(bench, design, tell):
        """Stands in for the compiler: meanwhile somebody opens the printed address."""
        [address] = re.findall(r"http:\S+", capsys.readouterr().out)
        port, token = re.search(r":(\d+)/\?token=(\S+)", address).groups()
        answer, _ = get(int(port), f"/?token={token}")
        cookie = {"Cookie": answer.headers["Set-Cookie"].split(";")[0]}
        url = f"127.0.0.1:{port}"
        with connect(f"ws://{url}/socket", origin=f"http://{url}", additional_headers=cookie) as s:
            heard.extend(json.loads(s.recv(timeout=60)) for _ in range(2))
        raise InputError(["no compiler"])

    monkeypatch.setattr(Bench, "warm", warm)
    with pytest.raises(InputError, match="no compiler"):
        studios.serve(desk, Console(width=200))
    assert heard[0]["about"]["objects"] == ["sphere"]
    assert heard[1]["state"].startswith("compiling the simulation")


def test_a_design_has_the_fewest_digits_that_mean_the_same(desk):
    space = desk.case.space
    random = np.random.default_rng(0)
    drawn = random.uniform(space.low, space.high, (200, 2)).astype(np.float32)
    dusty = space.from_units([[114.125, 0.1], [100.0, 30.0], [33.3, 1e-3]]).astype(np.float32)
    for design in (*drawn, *dusty):
        values = common.shortest(space, design.astype(float))
        np.testing.assert_array_equal(space.from_units(values).astype(np.float32), design)
        exact = space.in_units(design.astype(float))
        for value, other in zip(values, exact, strict=True):
            assert len(repr(value)) <= len(f"{other:.9g}".rstrip("0")) + 2, "at most '.0' more"
    shown = [common.shortest(space, design.astype(float)) for design in dusty]
    assert shown == [[114.125, 0.1], [100.0, 30.0], [33.3, 0.001]]


class Dropping(Studio):
    """A studio whose connections can be lost, as where a computer sleeps."""

    def __init__(self, desk):
        super().__init__(desk)
        self.connections = []
        self.lost = False

    def serve(self, connection):
        if not self.lost:
            self.connections.append(connection)
            super().serve(connection)

    def drop(self):
        connections = self.connections
        self.connections = []
        for connection in connections:
            connection.close()


@contextlib.contextmanager
def served(desk):
    """A studio that is served and has not begun, and its address."""
    studio = Dropping(desk)
    listening, address = studio.listen("127.0.0.1", 0)
    with listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield studio, address
        studio.close()


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A studio that has begun, and its address."""
    with served(Desk(cli.Studio(**OPTIONS, out=tmp_path_factory.mktemp("studio")))) as studio:
        studio[0].begin()
        yield studio


@contextlib.contextmanager
def visited(browser, address, width=1200):
    """The page in a browser; what it asks of another machine, and its errors, fail the test."""
    page = browser.new_context(viewport={"width": width, "height": 800}).new_page()
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    origin = address.split("?")[0]
    page.on("request", lambda r: None if r.url.startswith(origin) else complaints.append(r.url))
    page.goto(address)
    yield page
    page.context.close()
    assert complaints == []


@pytest.fixture
def page(browser, opened):
    """The page once it has its first verdict."""
    with visited(browser, opened[1]) as page:
        page.wait_for_selector(COMPLETE)
        yield page


COMPLETE = f"#studio .trials button:nth-child({COUNTS[0]}):is(.kept, .lost, .not_released, .fault)"
LENGTH = "#studio input[type=range][aria-label=length]"


@pytest.mark.browser
def test_a_moved_slider_changes_the_verdict_and_the_timeline_plays(page):
    assert "token" not in page.url, "which others may see"
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
def test_a_click_on_a_finger_opens_its_sliders(browser, tmp_path):
    """Its sliders have its colour; the verdict is that of the design before until the next one."""
    options = {**OPTIONS, "preset": "full", "out": tmp_path / "saved"}
    with served(Desk(cli.Studio(**options))) as (studio, address):
        studio.begin()
        with visited(browser, address) as page:
            page.wait_for_selector(COMPLETE)
            group = page.locator("#studio .group[data-part='finger 1']")
            group.evaluate("e => { e.open = false; }")
            view = "document.querySelector('.replay').replay"
            page.evaluate(f"{view}.pause()")
            canvas = page.locator("#studio .view").bounding_box()
            spot = spot_of(page, "#studio .view", view, "finger 1")
            page.mouse.click(canvas["x"] + spot[0], canvas["y"] + spot[1])
            until(lambda: group.evaluate("e => e.open"), page)
            assert "picked" in group.get_attribute("class")
            color = group.evaluate("e => getComputedStyle(e).borderLeftColor")
            hue = bodies.finger_color(1)
            assert color == f"rgb({', '.join(str(int(hue[k : k + 2], 16)) for k in (1, 3, 5))})"
            verdict = page.locator("#studio .verdict")
            before = verdict.inner_text()
            slider = group.locator("input[type=range]").first
            slider.evaluate("e => { e.value = e.min; e.dispatchEvent(new Event('input')); }")
            assert "stale" in verdict.get_attribute("class") and verdict.inner_text() == before
            slider.evaluate("e => e.dispatchEvent(new Event('change'))")
            until(lambda: "stale" not in verdict.get_attribute("class"), page)


@pytest.mark.browser
def test_two_tabs_work_and_a_closed_one_costs_nothing(page, opened, monkeypatch):
    studio, address = opened
    other = page.context.new_page()
    other.goto(address)
    other.wait_for_selector(COMPLETE)
    other.locator(LENGTH).press("Home")
    until(lambda: "keeps 0 %" in other.locator(".verdict").inner_text(), other)
    assert "keeps 0 %" not in page.locator(".verdict").inner_text()
    bench = studio.desk.bench("")
    simulated = []
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


@pytest.mark.browser
def test_a_page_waits_for_the_compiler(browser, tmp_path):
    """And shows by a bar which of the programs is compiled."""
    desk = Desk(cli.Studio(**OPTIONS, out=tmp_path))
    stages = len(desk.bench("").stages)
    with served(desk) as (studio, address), visited(browser, address) as page:
        state = page.locator("#studio .state")
        view = page.locator("#studio .message")
        until(lambda: "compiling the simulation" in state.inner_text(), page)
        assert "compiling the simulation" in view.inner_text()
        assert page.locator(LENGTH).is_visible(), "sliders are there"
        bar = page.locator("#studio .compiling")
        assert not bar.is_visible()
        bar.evaluate(
            """bar => {
              bar.seen = [];
              const look = () => { if (!bar.hidden) bar.seen.push(bar.value / bar.max); };
              new MutationObserver(look).observe(bar, { attributes: true });
            }"""
        )
        studio.begin()
        page.wait_for_selector(COMPLETE)
        assert (state.inner_text(), view.inner_text()) == ("", "")
        shares = dict.fromkeys(bar.evaluate("bar => bar.seen"))
        assert [*shares] == pytest.approx([(k + 0.5) / stages for k in range(stages)])
        assert not bar.is_visible()


@pytest.mark.browser
def test_a_lost_connection_comes_back_with_its_design(page, opened):
    """And so does a page that is loaded again, also by somebody who was sent its address."""
    studio, address = opened
    verdict = page.locator("#studio .verdict")
    error = page.locator("#studio .error")
    page.locator(LENGTH).press("Home")
    until(lambda: "keeps 0 % of 24" in verdict.inner_text(), page)
    page.locator("#studio .count").select_option("48")
    until(lambda: "keeps 0 % of 48" in verdict.inner_text(), page)
    before = studio.tabs[-1]
    studio.lost = True
    studio.drop()
    until(lambda: "There is no connection" in error.inner_text(), page)
    page.locator("#studio .save").click()
    until(lambda: "There is no connection" in error.inner_text(), page)
    studio.lost = False
    until(lambda: studio.tabs and studio.tabs[-1] is not before, page)
    until(lambda: not error.is_visible(), page)
    page.locator(LENGTH).press("ArrowRight")  # by a 400th of the range
    page.reload()
    until(lambda: "of 48" in verdict.inner_text(), page)
    row = page.locator("#studio .parameter input[type=number]").first
    length = float(row.input_value())
    assert 10 < length < 12, "the design is there again"
    with visited(page.context.browser, f"{address}#{page.url.split('#')[1]}") as other:
        other.wait_for_selector(COMPLETE)
        assert other.url == page.url
        other.goto(f"{address}#length=1e400&arm_z=x&count=7&object=9&quit")
        other.wait_for_selector(COMPLETE)
        assert "length=110" in other.url, "what is no design is passed over"


@pytest.mark.browser
def test_a_studio_that_was_started_again_is_told_apart(page, opened):
    """Its token is another one, so that the page of the one before is refused."""
    guard = opened[0].guard
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guard, "token", "another")
        opened[0].drop()
        error = page.locator("#studio .error")
        until(lambda: "The studio was started again" in error.inner_text(), page)
    until(lambda: not error.is_visible(), page)


@pytest.mark.browser
def test_a_double_click_exports_once(page, monkeypatch):
    children = Children(monkeypatch)
    button = page.locator("#studio .export")
    done = page.locator("#studio .done")
    button.dblclick()
    until(lambda: children.lines, page)
    assert button.is_disabled() and not page.locator("#studio .error").is_visible()
    children.ends.release()
    until(lambda: "exported: it" in done.inner_text(), page)
    assert len(children.lines) == 1 and button.is_enabled()


@pytest.mark.browser
def test_without_webgl_there_are_pictures_and_charts(launch, opened):
    flat = launch("--disable-3d-apis")
    with visited(flat, opened[1]) as page:
        page.wait_for_selector(COMPLETE)
        until(lambda: page.locator("#studio .strip img").count() == 7, page)
        assert "Pictures stand in place" in page.locator("#studio .message").inner_text()
        first = page.locator("#studio .strip img").nth(3).get_attribute("src")
        lines = page.locator("#studio .distance polyline")
        assert lines.count() == 2
        before = lines.first.get_attribute("points")
        page.locator(LENGTH).press("Home")
        strip = page.locator("#studio .strip img")
        until(lambda: strip.nth(3).get_attribute("src") != first, page)
        assert strip.count() == 7 and lines.first.get_attribute("points") != before
    flat.close()


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1000, 1200])
def test_names_of_phases_have_room(browser, opened, width):
    with visited(browser, opened[1], width) as page:
        page.wait_for_selector(COMPLETE)
        assert page.locator("html").evaluate("e => e.scrollWidth") == width
        chart = page.locator("#studio .distance").bounding_box()
        names = page.locator("#studio .distance .phase")
        boxes = [names.nth(k).bounding_box() for k in range(names.count())]
        assert len(boxes) == 5
        for box in boxes:
            assert chart["x"] <= box["x"] and box["x"] + box["width"] <= chart["x"] + chart["width"]
            assert box["y"] + box["height"] <= chart["y"] + chart["height"] + 1  # a rounded pixel
        for first, other in itertools.combinations(boxes, 2):
            apart = first["x"] + first["width"] < other["x"] or first["y"] != other["y"]
            assert apart or other["x"] + other["width"] < first["x"]
