// A click on the head of a column sorts a table by it: numbers by value, "64 of 64" by the first; again: the other way.
"use strict";

document.addEventListener("DOMContentLoaded", () => {
  const value = (row, column) => {
    const text = row.cells[column].textContent.trim(), number = parseFloat(text.replace(/,/g, ""));
    return Number.isNaN(number) ? text : number;
  };
  const before = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b)));
  for (const head of document.querySelectorAll("article table thead th")) {
    const body = head.closest("table").tBodies[0], column = head.cellIndex;
    head.style.cursor = "pointer";
    head.title = "sort";
    head.addEventListener("click", () => {
      const way = head.ariaSort === "descending" ? "ascending" : "descending";
      for (const other of head.parentElement.cells) other.ariaSort = null;
      head.ariaSort = way;
      const sign = way === "ascending" ? 1 : -1;
      body.append(...[...body.rows].sort((a, b) => sign * before(value(a, column), value(b, column))));
    });
  }
});
