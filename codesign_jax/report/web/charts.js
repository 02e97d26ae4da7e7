// Charts as SVG that answer to the pointer: values under it, zoom by dragging, layers by their names in the legend.
//
// Why not a library: a report is one file below 2 MB for readers without a network, made from what pip installs.
// plotly's package carries 4.8 MB of script and no smaller build, Bokeh's 1.3 MB with four packages that nothing else
// here needs; dygraphs (0.13 MB) draws lines alone; uPlot and Observable Plot are in no package of the index.
//
// startChart(root, spec) fills an element, which gets an event "at" with a place along x that was clicked.  spec has
//   x, y    {label, low, high, whole}; whole: only integers are ticks
//   layers  {kind, name, color, x, y, ...}; "line", "dots" (with texts `title`, `color` may be a list), "band" (from y
//           to high), "bars" (stacked), "cells" (y of the rows, values[k][j] at x[k], y[j], grey up to `most`)
//   lines   {y, text, color}: level lines;  marks: [[name, end], ...] spans along x, named below in place of ticks
//   height  [px]; legend: whether there is one
// and returns {cursor(x), load(spec)}.
"use strict";

function startChart(root, spec) {
  const NAMES = "http://www.w3.org/2000/svg", LETTER = 6.6, TOP = 8;  // px of a letter, and above the chart
  const svg = (tag, attributes, ...inside) => {
    const element = document.createElementNS(NAMES, tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...inside);
    return element;
  };
  const legend = document.createElement("div"), picture = svg("svg", { class: "chart" });
  const readout = document.createElement("div"), hidden = new Set();
  legend.className = "legend";
  readout.className = "readout";
  readout.hidden = true;
  root.classList.add("plot");
  root.replaceChildren(legend, picture, readout);
  let span, frame, at = null;  // what is shown along x; the chart's rectangle in px; the cursor's place

  const short = (v) => (Math.abs(v) >= 1e4 || v === 0 ? v.toFixed(0) : Number(v.toPrecision(4)).toString());
  function ticks(low, high, most, whole) {
    const raw = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
    let step = [1, 2, 5, 10].find((k) => k * power >= raw) * power;
    if (whole) step = Math.max(1, Math.round(step));
    const first = Math.ceil(low / step - 1e-9), last = Math.floor(high / step + 1e-9);
    return Array.from({ length: Math.max(last - first + 1, 0) }, (_, k) => Number(((first + k) * step).toPrecision(12)));
  }
  const across = (x) => frame.width * (x - span[0]) / (span[1] - span[0]);
  const up = (y) => frame.height * (1 - (y - spec.y.low) / (spec.y.high - spec.y.low));
  const path = (xs, ys) => xs.map((x, k) => `${across(x).toFixed(1)},${up(ys[k]).toFixed(1)}`).join(" ");
  const colorOf = (layer, k) => (Array.isArray(layer.color) ? layer.color[k] : layer.color);

  // ---- layers
  const draws = {
    line: ({ x, y, color, dash }) => [svg("polyline", { points: path(x, y), fill: "none", stroke: color,
      "stroke-width": 1.8, "stroke-linejoin": "round", ...(dash ? { "stroke-dasharray": dash } : {}) })],
    band: ({ x, y, high, color, opacity }) => [svg("polygon", { fill: color, "fill-opacity": opacity,
      points: `${path(x, high)} ${path([...x].reverse(), [...y].reverse())}` })],
    dots: (layer) => layer.x.map((x, k) => svg("circle", { cx: across(x), cy: up(layer.y[k]), r: layer.radius || 2.5,
      fill: colorOf(layer, k), "fill-opacity": layer.opacity || 1, ...(layer.edge ? { stroke: layer.edge } : {}) })),
    bars: ({ x, y, below, color }) => {
      const wide = Math.max(1, 0.8 * (across(1) - across(0)));
      return x.map((v, k) => svg("rect", { x: across(v) - wide / 2, y: up(below[k] + y[k]), width: wide,
        height: Math.max(up(below[k]) - up(below[k] + y[k]), 0), fill: color }));
    },
    cells: ({ x, y, values, most }) => x.flatMap((v, k) => y.map((w, j) => {
      const [left, right] = edges(x, k).map(across), [low, high] = edges(y, j).map(up);
      const grey = Math.round(255 * (1 - 0.85 * Math.min(values[k][j] / most, 1)));
      return svg("rect", { x: left, y: high, width: right - left + 0.3, height: low - high + 0.3,
        fill: `rgb(${grey},${grey},${grey})` });
    })),
  };
  function edges(values, k) {  // of the cell about a value
    const half = (a, b) => (values[b] - values[a]) / 2, last = values.length - 1;
    if (!last) return [values[0] - 0.5, values[0] + 0.5];
    return [values[k] - (k ? half(k - 1, k) : half(0, 1)), values[k] + (k < last ? half(k, k + 1) : half(last - 1, last))];
  }

  function draw() {
    const width = root.clientWidth, height = spec.height || 240, marks = spec.marks || [];
    if (!width) return;  // in a part of the page that is folded
    const rows = ticks(spec.y.low, spec.y.high, height / 45, spec.y.whole);
    const left = 10 + LETTER * Math.max(...rows.map((v) => short(v).length)) + (spec.y.label ? 16 : 0);
    const foot = (marks.length ? 28 : 18) + (spec.x.label ? 16 : 0);
    frame = { left, width: Math.max(width - left - 8, 20), height: height - TOP - foot };
    picture.setAttribute("viewBox", `0 0 ${width} ${height}`);
    picture.style.height = `${height}px`;
    const outside = svg("g", { transform: `translate(${left} ${TOP})` });
    // A nested <svg> clips what zoom puts outside.
    const inside = svg("svg", { x: left, y: TOP, width: frame.width, height: frame.height });
    for (const v of rows)
      outside.append(svg("line", { class: "grid", x2: frame.width, y1: up(v), y2: up(v) }),
        svg("text", { x: -6, y: up(v) + 4, "text-anchor": "end" }, short(v)));
    if (spec.y.label)
      outside.append(svg("text", { class: "name", transform: `translate(${12 - left} ${frame.height / 2}) rotate(-90)`, "text-anchor": "middle" }, spec.y.label));
    if (spec.x.label)
      outside.append(svg("text", { class: "name", x: frame.width / 2, y: frame.height + foot - 2, "text-anchor": "middle" }, spec.x.label));
    if (!marks.length)
      for (const v of ticks(...span, frame.width / 60, spec.x.whole))
        outside.append(svg("line", { class: "grid", x1: across(v), x2: across(v), y1: frame.height, y2: frame.height + 4 }),
          svg("text", { x: across(v), y: frame.height + 15, "text-anchor": "middle" }, short(v)));
    for (const [, end] of marks)
      inside.append(svg("line", { class: "grid", x1: across(end), x2: across(end), y2: frame.height }));
    for (const layer of spec.layers.filter(({ name }) => !hidden.has(name))) inside.append(...draws[layer.kind](layer));
    for (const { y, color, text } of spec.lines || [])
      inside.append(svg("line", { x2: frame.width, y1: up(y), y2: up(y), stroke: color, "stroke-dasharray": "5 4" },
        svg("title", {}, text)));
    inside.append(svg("line", { class: "cursor", y2: frame.height, visibility: "hidden" }),
      svg("rect", { class: "selection", height: frame.height, visibility: "hidden" }));
    picture.replaceChildren(outside, inside);
    nameMarks(outside, marks);
    cursor(at);
  }
  // Names of spans below the chart, each in the first of two lines that has room for it.
  function nameMarks(outside, marks) {
    const ends = [-Infinity, -Infinity], gap = 5;
    let from = spec.x.low;
    for (const [name, end] of marks) {
      const text = svg("text", { class: "phase", "text-anchor": "middle" }, name), middle = across((from + end) / 2);
      outside.append(text);
      from = end;
      const half = text.getComputedTextLength() / 2, x = Math.min(Math.max(middle, half - frame.left), frame.width - half);
      const line = ends.findIndex((last) => last + gap <= x - half);
      if (line < 0 || middle < 0 || middle > frame.width) {
        text.remove();
        continue;
      }
      ends[line] = x + half;
      text.setAttribute("x", x);
      text.setAttribute("y", frame.height + 12 + 12 * line);
    }
  }
  function nameLayers() {
    const named = spec.layers.filter((layer) => layer.name && !Array.isArray(layer.color));
    legend.hidden = spec.legend === false || !(named.length || (spec.lines || []).length);
    const chips = named.map(({ name, color }) => {
      const chip = document.createElement("button"), swatch = document.createElement("i");
      chip.type = "button";
      chip.title = "show or hide";
      swatch.style.background = color;
      chip.append(swatch, name);
      chip.classList.toggle("off", hidden.has(name));
      chip.addEventListener("click", () => {
        if (!hidden.delete(name)) hidden.add(name);
        nameLayers();
        draw();
      });
      return chip;
    });
    const levels = (spec.lines || []).map(({ text, color }) => {
      const words = document.createElement("span"), swatch = document.createElement("i");
      swatch.className = "dashed";
      swatch.style.borderColor = color;
      words.append(swatch, text);
      return words;
    });
    legend.replaceChildren(...chips, ...levels);
  }

  // ---- the pointer
  function cursor(x) {
    at = x;
    const line = picture.querySelector(".cursor");
    if (!line) return;
    line.setAttribute("visibility", x === null ? "hidden" : "visible");
    if (x === null) return;
    for (const end of ["x1", "x2"]) line.setAttribute(end, across(x));
  }
  const nearest = (values, x) => values.reduce((best, v, k) => (Math.abs(v - x) < Math.abs(values[best] - x) ? k : best), 0);
  // Lines of text about the place under the pointer [px of the chart].
  function about(px, py) {
    const x = span[0] + (span[1] - span[0]) * px / frame.width;
    const y = spec.y.high - (spec.y.high - spec.y.low) * py / frame.height;
    const words = [], unit = spec.x.label ? `${spec.x.label}: ` : "";
    let place = null;
    for (const layer of spec.layers.filter(({ name, x: xs }) => !hidden.has(name) && xs.length)) {
      const { kind, name } = layer;
      if (kind === "cells") {
        const k = nearest(layer.x, x), j = nearest(layer.y, y);
        words.push([`${name}: ${short(layer.values[k][j])}`], [`${unit}${short(layer.x[k])}`], [`${spec.y.label}: ${short(layer.y[j])}`]);
      } else if (layer.title) {
        const off = layer.x.map((v, k) => Math.hypot(across(v) - px, up(layer.y[k]) - py)), k = off.indexOf(Math.min(...off));
        if (off[k] < 30) words.push([layer.title[k], colorOf(layer, k)]);
      } else {
        const k = nearest(layer.x, x), here = layer.x[k];
        place ??= here;
        const same = kind === "dots" ? layer.y.filter((_, j) => layer.x[j] === here) : [layer.y[k]];
        const low = Math.min(...same), high = kind === "band" ? layer.high[k] : Math.max(...same);
        words.push([`${name}: ${short(low)}${high > low ? ` to ${short(high)}` : ""}`, layer.color]);
      }
    }
    if (place !== null) words.unshift([`${unit}${short(place)}`]);
    return words;
  }
  const local = (event) => {
    const box = picture.getBoundingClientRect();
    return [event.clientX - box.left - frame.left, event.clientY - box.top - TOP];
  };
  const within = ([x, y]) => x >= -4 && x <= frame.width + 4 && y >= -4 && y <= frame.height + 30;
  const valueAt = (px) => span[0] + (span[1] - span[0]) * Math.min(Math.max(px / frame.width, 0), 1);
  let start = null;
  function point(event) {
    const place = local(event), words = within(place) ? about(...place) : [];
    readout.hidden = !words.length;
    readout.replaceChildren(...words.map(([text, color]) => {
      const line = document.createElement("div"), swatch = document.createElement("i");
      swatch.style.background = color || "none";
      line.append(swatch, text);
      return line;
    }));
    const right = frame.left + place[0] > root.clientWidth / 2;
    readout.style.left = right ? "auto" : `${frame.left + place[0] + 14}px`;
    readout.style.right = right ? `${root.clientWidth - frame.left - place[0] + 14}px` : "auto";
    readout.style.top = `${legend.offsetHeight + 12}px`;
    const selection = picture.querySelector(".selection");
    if (start === null || event.pointerType === "touch") return;  // a finger scrolls the page
    const [low, high] = [start, place[0]].sort((a, b) => a - b);
    selection.setAttribute("visibility", "visible");
    selection.setAttribute("x", low);
    selection.setAttribute("width", high - low);
  }
  function release(event) {
    if (start === null) return;
    const ends = [start, local(event)[0]].sort((a, b) => a - b), [low, high] = ends.map(valueAt);
    start = null;
    if (ends[1] - ends[0] < 6) {
      root.dispatchEvent(new CustomEvent("at", { detail: low }));
      picture.querySelector(".selection").setAttribute("visibility", "hidden");
    } else if (event.pointerType !== "touch") {
      span = [low, high];
      draw();
    }
  }
  picture.addEventListener("pointermove", (event) => frame && point(event));
  picture.addEventListener("pointerdown", (event) => {
    if (!frame || !within(local(event))) return;
    start = local(event)[0];
    if (event.pointerType !== "touch") picture.setPointerCapture(event.pointerId);
    point(event);
  });
  picture.addEventListener("pointerup", release);
  picture.addEventListener("pointercancel", () => { start = null; });
  picture.addEventListener("pointerleave", () => { readout.hidden = true; });
  picture.addEventListener("dblclick", () => { span = [spec.x.low, spec.x.high]; draw(); });

  function load(other) {
    const same = span && spec.x.low === other.x.low && spec.x.high === other.x.high;
    spec = other;
    if (!same) span = [spec.x.low, spec.x.high];
    nameLayers();
    draw();
  }
  load(spec);
  new ResizeObserver(draw).observe(root);
  root.chart = { cursor, load, shown: () => span };
  return root.chart;
}
