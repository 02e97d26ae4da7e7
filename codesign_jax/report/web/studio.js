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
  const kinds = { good: "good", "not good": "bad" };  // classes of verdicts; of all others: open
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
    find("verdict").classList.add("stale");
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

  // ---- sliders, a group for each finger and for the rest, in the colour that the finger has everywhere
  const FEW = 12;  // parameters up to which all groups begin open
  function addSliders() {
    about.groups.forEach(({ title, members, part, color }, first) => {
      const group = make("details", { className: "group", open: !first || about.parameters.length <= FEW },
        make("summary", { textContent: title }));
      if (color) group.style.setProperty("--part", color);
      if (part) {
        group.dataset.part = part;
        group.addEventListener("pointerenter", () => stage.replay && stage.replay.highlight(part));
        group.addEventListener("pointerleave", () => stage.replay && stage.replay.highlight(null));
      }
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
        group.append(make("label", { className: "parameter" }, make("span", { textContent: label }), slider, number, words));
      }
      find("parameters").append(group);
    });
  }
  stage.addEventListener("pick", ({ detail }) => {
    for (const group of root.querySelectorAll(".group")) {
      group.classList.toggle("picked", group.dataset.part === detail);
      if (group.dataset.part !== detail) continue;
      group.open = true;
      group.scrollIntoView({ block: "nearest" });
    }
    stage.replay.highlight(find("picked") ? detail : null);
  });
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
    find("accuracy").append(...about.accuracies.map((name) => option(name, name || about.accuracy)));
    find("count").append(...about.counts.map((count) => option(count, count)));
    for (const element of root.querySelectorAll(".of-run")) element.hidden = !about.run;
    if (about.run) {
      find("of-run-verdict").textContent = about.run.verdict;
      find("of-run-verdict").classList.add(kinds[about.run.word] || "open");
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

  // ---- charts over the time of the grasp, with its phases, and of the designs tried
  const charts = {};
  function plot(name, spec) {
    if (charts[name]) charts[name].load(spec);
    else charts[name] = startChart(find(name), spec);
  }
  function plotLines(name, layers, least, lines = []) {
    const { rate, phases, frames } = grasp.replay, x = Array.from({ length: frames }, (_, k) => k / rate);
    const top = Math.max(least, ...layers.flatMap(({ y }) => y));
    plot(name, { x: { low: 0, high: (frames - 1) / rate }, y: { low: 0, high: 1.04 * top }, marks: phases, lines, height: 130,
      layers: layers.map((layer) => ({ kind: "line", x, ...layer })) });
  }
  function plotGrasp() {
    const { distance, height, lost, grip } = grasp.series;
    if (grip) find("gripping").hidden = false;  // before the widths of the others are asked for
    plotLines("distance", [{ name: "object above the table", color: "#c96a10", y: height },
      { name: "object to hand", color: "#2f6fab", y: distance }], 250, [{ y: lost, color: "#cf4b3f", text: "farther is lost" }]);
    find("grip").style.opacity = grip ? 1 : 0.3;  // of the grasp before, while a slider moves
    if (grip) plotLines("grip", grip.map((y, f) => ({ name: `finger ${f}`, color: about.colors[f], y })), 2);
  }
  function plotTried() {
    const last = tried.slice(-40), x = last.map((_, k) => k), worst = about.worst;
    plot("tried", { x: { low: -0.5, high: Math.max(last.length - 0.5, 12), whole: true }, y: { low: 0, high: 1.05 * worst }, height: 130,
      layers: [{ kind: "dots", x, y: last.map(({ cost }) => Math.min(cost, worst)), radius: 4.5,
        color: last.map((design) => (design === tried.at(-1) ? "#1d2733" : "#2f6fab")),
        title: last.map(({ sentence, cost }) => `mean cost ${cost.toFixed(2)}: ${sentence.split(" fresh")[0].slice(0, 40)}`) }] });
  }
  find("tried").addEventListener("at", ({ detail }) => {
    const before = tried.slice(-40)[Math.max(Math.round(detail), 0)];
    if (!before) return;
    before.design.forEach((value, i) => set(rows[i], value));
    show();
  });
  for (const name of ["distance", "grip"])
    find(name).addEventListener("at", ({ detail }) => { if (stage.replay) { stage.replay.pause(); stage.replay.seek(detail); } });
  stage.addEventListener("time", ({ detail }) => {
    for (const name of ["distance", "grip"]) if (charts[name]) charts[name].cursor(detail);
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
      else if (!find("verdict").classList.contains("stale")) takes.state("");
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
  function judged({ number, ends, total, sentence, word, cost, design }) {
    if (number !== null && number !== asked) return;
    const complete = ends.length === total;
    if (complete || !find("verdict").textContent) {
      find("verdict").textContent = sentence;
      find("verdict").className = `verdict ${kinds[word] || "open"}`;
    }
    find("verdict").classList.toggle("stale", !complete);  // that of the design before, until the new one is there
    if (number !== null) takes.state(complete ? "" : ends.length ? `so far: ${sentence}` : "the verdict comes ...");
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
    stage: (step) => {
      const ends = !step && !find("compiling").hidden;
      find("compiling").hidden = !step;
      if (ends) takes.state("simulating ...");
      if (!step) return;
      find("compiling").max = step.of;
      find("compiling").value = step.number - 0.5;
      takes.state(`compiling ${step.number} of ${step.of}: ${step.name}; up to a minute each the first time ...`);
    },
    improving: (on) => { find("improve").textContent = on ? "Stop improving" : "Improve"; },
    error: (text) => {
      takes.stage(null);
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
