// The page of `codesign studio`: sliders and buttons of a design; what the command simulates of it comes over a
// WebSocket, and replay.js plays it.  Messages are JSON with one key each, see commands/studio.py.
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
  const socket = new WebSocket(`ws://${location.host}/socket`);
  let about, grasp, asked = 0, rows = [], tried = [];
  const send = (message) => socket.send(JSON.stringify(message));

  // ---- what is asked for
  // resting: no slider is being moved, so that the verdict may follow; the newest request alone counts.
  function show(resting = true) {
    const noise = find("noise").value;
    asked += 1;
    find("state").textContent = "simulating ...";
    send({ show: { number: asked, resting, design: rows.map((row) => row.value),
      object: Number(find("object").value), noise: noise === "" ? null : Number(noise),
      accuracy: find("accuracy").value, trials: Number(find("count").value) } });
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
    about = message;
    find("what").textContent = about.title;
    find("object").append(...about.objects.map((name, k) => option(k, name)));
    find("accuracy").append(...about.accuracies.map((name) => option(name, name || "the scene's")));
    find("count").append(...about.counts.map((count) => option(count, count)));
    for (const element of root.querySelectorAll(".of-run")) element.hidden = !about.run;
    if (about.run) {
      find("episode").max = about.run.episodes;
      find("particle").max = about.run.particles - 1;
      [find("episode").value, find("particle").value] = about.run.chosen;
    }
    addSliders();
    noises();
    about.design.forEach((value, k) => set(rows[k], value));
    show();
  }

  // ---- charts
  const left = 34, bottom = 92;
  const drawn = (name, ...parts) => {
    find(name).setAttribute("viewBox", `0 0 ${find(name).clientWidth} 110`);
    find(name).replaceChildren(...parts);
  };
  const right = (name) => find(name).clientWidth - 4;
  const across = (name, time) => left + (right(name) - left) * time / stage.replay.end();
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
        svg("text", { x: across(name, (from + end) / 2), y: 106, "text-anchor": "middle" }, phase));
      from = end;
    }
    if (dashed !== null) parts.push(svg("line", { x1: left, x2: right(name), y1: up(dashed), y2: up(dashed), stroke: "#cf4b3f", "stroke-dasharray": "4 3" }));
    for (const [values, stroke] of lines)
      parts.push(svg("polyline", { fill: "none", stroke, "stroke-width": 1.6,
        points: values.map((v, k) => `${across(name, k / grasp.replay.rate).toFixed(1)},${up(v).toFixed(1)}`).join(" ") }));
    drawn(name, ...parts, svg("line", { class: "cursor", x1: left, x2: left, y1: 6, y2: bottom, stroke: "#1d2733" }));
  }
  const colors = ["#2f6fab", "#c96a10", "#3d9a5f", "#8a63b3", "#cf4b3f", "#5a6776", "#b59f00", "#00909e"];
  function plotGrasp() {
    if (!stage.replay) return;  // no WebGL
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
    else if (!stage.classList.contains("still") && startReplay(stage, { ...grasp.replay, strip: [] })) stage.replay.play();
    if (grasp.number === null || grasp.number === asked) {  // else a slider has moved on
      grasp.design.forEach((value, k) => set(rows[k], value));
      if (grasp.number !== null) find("state").textContent = "";
    }
    rows.forEach((row, k) => {
      const limit = grasp.limits[k];
      row.words.textContent = limit === null ? row.unit : `${row.unit}, ≤ ${Math.floor(limit)}`;
      row.words.classList.toggle("full", limit !== null && grasp.design[k] > 0.99 * limit);
    });
    find("error").hidden = true;
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
      const dot = make("button", { type: "button", className: end, title: `trial ${k}, ${about.objects[object]}: ${end || "to come"}` });
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
    state: (text) => { find("state").textContent = text; },
    done: (text) => { find("done").textContent = text; },
    improving: (on) => { find("improve").textContent = on ? "Stop improving" : "Improve"; },
    error: (text) => {
      find("error").textContent = text;
      find("error").hidden = false;
      find("state").textContent = "";
    },
  };
  socket.addEventListener("message", (event) => {
    for (const [name, value] of Object.entries(JSON.parse(event.data))) takes[name](value);
  });
  socket.addEventListener("close", () => takes.error("The studio has stopped. Open the address that it prints when it is started again."));

  for (const name of ["object", "count"]) find(name).addEventListener("change", () => { noises(); show(); });
  for (const name of ["noise", "accuracy"]) find(name).addEventListener("change", () => show());
  const ofRun = () => send({ run: [Number(find("episode").value), Number(find("particle").value)] });
  for (const name of ["episode", "particle"]) find(name).addEventListener("change", ofRun);
  find("chosen-design").addEventListener("click", () => {
    [find("episode").value, find("particle").value] = about.run.chosen;
    send({ run: null });
  });
  for (const name of ["improve", "save", "export", "page", "report"])
    find(name).addEventListener("click", () => { send({ [name]: true }); });
  root.studio = { asked: () => asked, grasp: () => grasp };
}
document.addEventListener("DOMContentLoaded", () => {
  history.replaceState(null, "", "/");  // without the token, which a cookie has
  startStudio(document.getElementById("studio"));
});
