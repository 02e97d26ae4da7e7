// The page of `codesign studio`: sliders and buttons of a design; what the command simulates of it comes over a
// WebSocket, and replay.js plays it.  Messages are JSON with one key each, see studio/tab.py.
"use strict";

function startStudio(root) {
  const find = (name) => root.querySelector(`.${name}`), stage = find("replay");
  const make = (tag, properties, ...inside) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...inside);
    return element;
  };
  const svg = (tag, attributes, text = "") => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.textContent = text;
    return element;
  };
  let socket, about, grasp, asked = 0, rows = [], tried = [], running = false;

  // ---- the connection, which a sleeping computer or a tunnel loses; the design stays on the page
  const LOST = "There is no connection to the studio. The page connects again by itself, with this design; " +
    "if the studio was stopped, start it again and open the address that it prints.";
  const ANEW = "The studio was started again: open the address that it prints. To go on with this design, " +
    "append the end of this page's address, from # on.";
  let wait = 500, timer = 0;  // [ms]
  function connect() {
    clearTimeout(timer);
    timer = 0;
    const url = new URL("socket", location.origin + location.pathname);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    socket = new WebSocket(url);
    socket.addEventListener("open", () => {
      wait = 500;
      find("error").hidden = true;
      takes.improving(false);
      running = false;
      enable();
    });
    socket.addEventListener("message", (event) => {
      for (const [name, value] of Object.entries(JSON.parse(event.data))) takes[name](value);
    });
    socket.addEventListener("close", async () => {
      const answer = await fetch(location.pathname, { cache: "no-store" }).catch(() => null);
      takes.error(answer && answer.status === 403 ? ANEW : LOST);
      timer = setTimeout(connect, wait);
      wait = Math.min(2 * wait, 8000);
    });
  }
  document.addEventListener("visibilitychange", () => { if (timer && !document.hidden) connect(); });
  function send(message) {
    if (socket.readyState !== WebSocket.OPEN) {
      takes.error(LOST);
      return;
    }
    find("error").hidden = true;
    socket.send(JSON.stringify(message));
  }

  // ---- what is asked for
  // resting: no slider is being moved, so that the verdict may follow; the newest request alone counts.
  function show(resting = true) {
    const noise = find("noise").value;
    asked += 1;
    takes.state("simulating ...");
    send({ show: { number: asked, resting, design: rows.map((row) => row.value),
      object: Number(find("object").value), noise: noise === "" ? null : Number(noise),
      accuracy: find("accuracy").value, trials: Number(find("count").value),
      pictures: stage.classList.contains("still") } });
    if (resting) keep();
  }
  // What is asked for stands in the address behind #, where a page that is loaded again finds it.
  const choices = ["object", "count", "noise", "accuracy"];
  function keep() {
    const words = rows.map((row, k) => [about.parameters[k].name, Number(row.value.toPrecision(9))]);
    for (const name of choices) if (find(name).value !== find(name).options[0].value) words.push([name, find(name).value]);
    history.replaceState(null, "", `${location.pathname}#${new URLSearchParams(words)}`);
  }
  function restore() {
    const words = new URLSearchParams(location.hash.slice(1));
    rows.forEach((row, k) => {
      const { name, low, high } = about.parameters[k], value = Number(words.get(name) ?? NaN);
      if (Number.isFinite(value)) set(row, Math.min(Math.max(value, low), high));
    });
    for (const name of choices) {
      const known = [...find(name).options].map((choice) => choice.value);
      if (known.includes(words.get(name))) find(name).value = words.get(name);
      noises();  // which follow from the object and the number of trials
    }
  }
  function set(row, value) {
    row.value = row.slider.value = value;
    row.number.value = Number(value.toPrecision(4));
  }

  // ---- sliders, a group for each finger and for the rest
  function addSliders() {
    for (const { title, members } of about.groups) {
      find("parameters").append(make("h2", { textContent: title }));
      for (const k of members) {
        const { name, label, unit, low, high, step } = about.parameters[k];
        const number = make("input", { type: "number", min: low, max: high, step: "any", ariaLabel: `${name} [${unit}]` });
        const slider = make("input", { type: "range", min: low, max: high, step, ariaLabel: name });
        const words = make("span", { className: "unit", textContent: unit });
        const row = { unit, slider, number, words, value: low };
        rows[k] = row;
        slider.addEventListener("input", () => { set(row, Number(slider.value)); show(false); });
        slider.addEventListener("change", () => show());
        number.addEventListener("change", () => { if (number.reportValidity()) { set(row, Number(number.value)); show(); } });
        slider.title = `${low} to ${high} ${unit}`;
        find("parameters").append(make("label", { className: "parameter" }, make("span", { textContent: label }), slider, number, words));
      }
    }
  }
  const option = (value, textContent) => make("option", { value, textContent });
  function noises() {
    const object = Number(find("object").value), objects = about.objects.length;
    const own = Array.from({ length: Math.ceil(Number(find("count").value) / objects) }, (_, k) => k * objects + object);
    const now = find("noise").value;
    find("noise").replaceChildren(option("", "none"), ...own.map((trial) => option(trial, `trial ${trial}`)));
    find("noise").value = own.includes(Number(now)) && now !== "" ? now : "";
  }
  function start(message) {
    if (about && JSON.stringify(about) !== JSON.stringify(message)) {
      location.reload();  // of another hand
      return;
    }
    if (about) {  // connected again
      show();
      return;
    }
    about = message;
    find("what").textContent = about.title;
    find("object").append(...about.objects.map((name, k) => option(k, name)));
    find("accuracy").append(...about.accuracies.map((name) => option(name, name || "the scene's")));
    find("count").append(...about.counts.map((count) => option(count, count)));
    for (const element of root.querySelectorAll(".of-run")) element.hidden = !about.run;
    if (about.run) {
      find("of-run-verdict").textContent = about.run.verdict;
      find("of-run-verdict").hidden = false;
      find("episode").max = about.run.episodes;
      find("particle").max = about.run.particles - 1;
      [find("episode").value, find("particle").value] = about.run.chosen;
    }
    addSliders();
    noises();
    about.design.forEach((value, k) => set(rows[k], value));
    restore();
    show();
  }

  // ---- charts
  const left = 34, bottom = 92;
  const drawn = (name, ...parts) => {
    find(name).setAttribute("viewBox", `0 0 ${find(name).clientWidth} 120`);
    find(name).replaceChildren(...parts);
  };
  const right = (name) => find(name).clientWidth - 4;
  const ending = () => (grasp.replay.frames - 1) / grasp.replay.rate;  // of the grasp [s]
  const across = (name, time) => left + (right(name) - left) * time / ending();
  const level = (name, y, text) => [svg("line", { x1: left, x2: right(name), y1: y, y2: y, stroke: "#e4e9ef" }),
    svg("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, text)];
  // Lines over the time of the grasp, [values, colour] each, with its phases and a cursor.
  function plotLines(name, lines, least, dashed = null) {
    const top = Math.max(least, ...lines.flatMap(([values]) => values)), parts = [];
    const up = (value) => bottom - 86 * Math.max(value, 0) / top;
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((v) => top / v <= 4) || 1000;
    for (let v = 0; v <= top; v += step) parts.push(...level(name, up(v), v));
    let from = 0;
    for (const [phase, end] of grasp.replay.phases) {
      parts.push(svg("line", { x1: across(name, end), x2: across(name, end), y1: 6, y2: bottom, stroke: "#d7dde4" }),
        svg("text", { class: "phase", x: across(name, (from + end) / 2), "text-anchor": "middle" }, phase));
      from = end;
    }
    if (dashed !== null) parts.push(svg("line", { x1: left, x2: right(name), y1: up(dashed), y2: up(dashed), stroke: "#cf4b3f", "stroke-dasharray": "4 3" }));
    for (const [values, stroke] of lines)
      parts.push(svg("polyline", { fill: "none", stroke, "stroke-width": 1.6,
        points: values.map((v, k) => `${across(name, k / grasp.replay.rate).toFixed(1)},${up(v).toFixed(1)}`).join(" ") }));
    if (stage.replay) parts.push(svg("line", { class: "cursor", x1: left, x2: left, y1: 6, y2: bottom, stroke: "#1d2733" }));
    drawn(name, ...parts);
    placePhases(name);
  }
  // Names of phases within the chart, each in the first of two lines that has room for it.
  function placePhases(name) {
    const ends = [-Infinity, -Infinity], gap = 5;
    for (const text of find(name).querySelectorAll(".phase")) {
      const half = text.getComputedTextLength() / 2;
      const x = Math.min(Math.max(Number(text.getAttribute("x")), left + half), right(name) - half);
      const line = ends.findIndex((end) => end + gap <= x - half);
      if (line < 0) {
        text.remove();
        continue;
      }
      ends[line] = x + half;
      text.setAttribute("x", x);
      text.setAttribute("y", 104 + 12 * line);
    }
  }
  const colors = ["#2f6fab", "#c96a10", "#3d9a5f", "#8a63b3", "#cf4b3f", "#5a6776", "#b59f00", "#00909e"];
  function plotGrasp() {
    const { distance, height, lost, grip } = grasp.series;
    if (grip) find("gripping").hidden = false;  // before the widths of the others are asked for
    plotLines("distance", [[height, "#c96a10"], [distance, "#2f6fab"]], 250, lost);
    find("grip").style.opacity = grip ? 1 : 0.3;  // of the grasp before, while a slider moves
    if (!grip) return;
    plotLines("grip", grip.map((values, f) => [values, colors[f % colors.length]]), 2);
    find("fingers").replaceChildren(...grip.map((_, f) => make("span", { textContent: ` ${f}`, style: `color: ${colors[f % colors.length]}` })));
  }
  function plotTried() {
    const last = tried.slice(-40), up = (cost) => bottom - 82 * Math.min(cost / about.worst, 1);
    const parts = [0, about.worst / 2, about.worst].flatMap((cost) => level("tried", up(cost), cost));
    last.forEach((one, k) => {
      const x = left + 8 + (right("tried") - left - 16) * k / Math.max(last.length - 1, 12);
      const dot = svg("circle", { cx: x, cy: up(one.cost), r: 4.5, style: "cursor: pointer", fill: one === tried.at(-1) ? "#1d2733" : "#2f6fab" });
      dot.append(svg("title", {}, `${one.sentence}; mean cost ${one.cost.toFixed(2)}`));
      dot.addEventListener("click", () => { one.design.forEach((value, i) => set(rows[i], value)); show(); });
      parts.push(dot);
    });
    drawn("tried", ...parts);
  }
  new ResizeObserver(() => { if (grasp) { plotGrasp(); plotTried(); } }).observe(find("charts"));
  stage.addEventListener("time", (event) => {
    for (const name of ["distance", "grip"])
      for (const cursor of find(name).querySelectorAll(".cursor"))
        for (const end of ["x1", "x2"]) cursor.setAttribute(end, across(name, event.detail));
  });

  // ---- what comes
  function shown(message) {
    grasp = message;
    if (stage.replay) stage.replay.load(grasp.replay);
    else if (!stage.classList.contains("still")) {
      if (startReplay(stage, { ...grasp.replay, strip: [] })) stage.replay.play();
      else show();  // with pictures
    }
    if (stage.replay) find("message").textContent = "";
    if (grasp.number === null || grasp.number === asked) {  // else a slider has moved on
      grasp.design.forEach((value, k) => set(rows[k], value));
      if (grasp.number === null) keep();
      else takes.state("");
    }
    rows.forEach((row, k) => {
      const limit = grasp.limits[k];
      row.words.textContent = limit === null ? row.unit : `${row.unit}, ≤ ${Math.floor(limit)}`;
      row.words.classList.toggle("full", limit !== null && grasp.design[k] > 0.99 * limit);
    });
    find("ending").textContent = `This grasp: ${grasp.ending}, cost ${grasp.cost.toFixed(2)}`;
    find("overlap").textContent = "";
    find("warnings").replaceChildren(...grasp.warnings.map((textContent) => make("li", { textContent })));
    plotGrasp();
  }
  function judged({ number, ends, total, sentence, cost, design }) {
    if (number !== null && number !== asked) return;
    find("verdict").textContent = sentence;
    find("trials").replaceChildren(...Array.from({ length: total }, (_, k) => {
      const object = k % about.objects.length, end = about.ends[ends[k]] || "";
      const dot = make("button", { type: "button", className: end, title: `trial ${k}, ${about.objects[object]}: ${(end || "to come").replace("_", " ")}` });
      dot.classList.toggle("chosen", find("noise").value === String(k));
      dot.addEventListener("click", () => {
        find("object").value = object;
        noises();
        find("noise").value = k;
        show();
      });
      return dot;
    }));
    if (ends.length === total && cost !== null) {
      tried = tried.filter((one) => String(one.design) !== String(design));
      tried.push({ cost, design, sentence });
      plotTried();
    }
  }
  const takes = {
    about: start, grasp: shown, verdict: judged,
    overlap: (text) => { find("overlap").textContent = text; },
    pictures: (strip) => showStrip(stage, strip),
    state: (text) => {
      find("state").textContent = text;
      if (!grasp) find("message").textContent = text;
    },
    done: (text) => {
      find("done").textContent = text;
      running = text.endsWith("\n...");  // a command, one at a time
      enable();
    },
    improving: (on) => { find("improve").textContent = on ? "Stop improving" : "Improve"; },
    error: (text) => {
      find("error").textContent = text;
      find("error").hidden = false;
      takes.state("");
      enable();
    },
  };
  function enable() {
    for (const name of ["export", "report"]) find(name).disabled = running;
  }
  connect();

  for (const name of ["object", "count"]) find(name).addEventListener("change", () => { noises(); show(); });
  for (const name of ["noise", "accuracy"]) find(name).addEventListener("change", () => show());
  const ofRun = () => send({ run: [Number(find("episode").value), Number(find("particle").value)] });
  for (const name of ["episode", "particle"]) find(name).addEventListener("change", ofRun);
  find("chosen-design").addEventListener("click", () => {
    [find("episode").value, find("particle").value] = about.run.chosen;
    send({ run: null });
  });
  for (const name of ["improve", "save", "export", "page", "report"])
    find(name).addEventListener("click", (event) => {
      if (name === "export" || name === "report") event.target.disabled = true;  // against a double click
      send({ [name]: true });
    });
  root.studio = { asked: () => asked, grasp: () => grasp };
}
document.addEventListener("DOMContentLoaded", () => {
  history.replaceState(null, "", location.pathname + location.hash);  // without the token, which a cookie has
  startStudio(document.getElementById("studio"));
});
