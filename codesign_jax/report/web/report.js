// What of a report answers to one another: a finger in the picture and its rows; a place along the chart of the grip
// and the time of the grasp; wide tables and the hint that they scroll.
"use strict";

document.addEventListener("DOMContentLoaded", () => {
  const stage = document.querySelector(".replay"), grip = document.getElementById("grip");
  const rows = [...document.querySelectorAll("[data-part]")];
  function choose(name) {
    for (const row of rows) row.classList.toggle("picked", row.dataset.part === name);
    if (stage && stage.replay) stage.replay.highlight(name);
  }
  for (const row of rows) row.addEventListener("click", () => choose(row.classList.contains("picked") ? null : row.dataset.part));
  if (stage) {
    stage.addEventListener("pick", ({ detail }) => choose(detail));
    if (grip) {
      stage.addEventListener("time", ({ detail }) => grip.chart.cursor(detail));
      grip.addEventListener("at", ({ detail }) => {
        if (!stage.replay) return;
        stage.replay.pause();
        stage.replay.seek(detail);
      });
    }
  }
  for (const table of document.querySelectorAll(".table")) {
    const inside = table.firstElementChild;
    const hint = () => table.classList.toggle("more", inside.scrollWidth - inside.clientWidth - inside.scrollLeft > 2);
    inside.addEventListener("scroll", hint);
    new ResizeObserver(hint).observe(inside);
  }
});
