"use strict";
(() => {
  const each = (selector, act) => document.querySelectorAll(selector).forEach(act);

  // Tables: a click on a heading sorts by that column, another one the other way round.
  const order = (row, column) => {
    const cell = row.cells[column];
    return cell.dataset.order === undefined ? cell.textContent.trim() : Number(cell.dataset.order);
  };
  const compare = (a, b) =>
    typeof a === "number" && typeof b === "number" ? a - b
      : typeof a !== typeof b ? (typeof a === "number" ? -1 : 1) : a.localeCompare(b);
  const sort = (table, column, heading) => {
    const down = heading.getAttribute("aria-sort") === "ascending";
    table.querySelectorAll("thead th").forEach((other) => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
    const body = table.tBodies[0];
    const rows = [...body.rows].sort((a, b) => compare(order(a, column), order(b, column)));
    body.append(...(down ? rows.reverse() : rows));
  };
  each("table:not(.unsorted)", (table) => {
    if (table.tBodies[0].rows.length < 2) return;
    table.querySelectorAll("thead th").forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...heading.childNodes);
      button.addEventListener("click", () => sort(table, column, heading));
      heading.append(button);
    });
  });

  // Figures: enlarged in a dialog, into which the drawing moves and from which it comes back.
  const dialog = document.getElementById("large");
  const room = dialog.querySelector(".room");
  let home = null;
  each("figure", (figure) => {
    const drawing = figure.firstElementChild;
    if (!drawing.querySelector("svg")) return;
    const button = figure.querySelector(".enlarge");
    button.hidden = false;
    button.addEventListener("click", () => {
      home = figure;
      room.append(drawing);
      dialog.showModal();
    });
  });
  dialog.addEventListener("close", () => {
    if (home) home.prepend(room.firstElementChild);
    home = null;
  });
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());

  // Charts: what is said of the time under the pointer, or under the cross-hair that the arrow keys move.
  each(".chart", (frame) => {
    const data = JSON.parse(frame.querySelector("script").textContent);
    const chart = frame.querySelector("svg");
    const cross = chart.querySelector(".cross");
    const hair = cross.querySelector("line");
    const dots = [...cross.querySelectorAll("circle")];
    const out = frame.querySelector(".read-out");
    let at = 0;
    const show = (bin) => {
      at = Math.min(Math.max(bin, 0), data.x.length - 1);
      for (const end of ["x1", "x2"]) hair.setAttribute(end, data.x[at]);
      hair.setAttribute("y1", data.top);
      hair.setAttribute("y2", data.bottom);
      dots.forEach((dot, series) => {
        const y = data.dots[series][at];
        dot.setAttribute("visibility", y === null ? "hidden" : "inherit");
        dot.setAttribute("cx", data.x[at]);
        dot.setAttribute("cy", y ?? 0);
      });
      cross.classList.add("on");
      out.textContent = data.says[at];
    };
    const nearest = (x) => {
      let best = 0;
      data.x.forEach((place, bin) => {
        if (Math.abs(place - x) < Math.abs(data.x[best] - x)) best = bin;
      });
      return best;
    };
    const point = (event) => {
      const box = chart.getBoundingClientRect();
      show(nearest(((event.clientX - box.left) / box.width) * data.width));
    };
    chart.addEventListener("pointermove", point);
    chart.addEventListener("pointerdown", point);
    chart.setAttribute("tabindex", "0");
    chart.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: -20, PageDown: 20, Home: -Infinity, End: Infinity };
      if (!(event.key in steps)) return;
      event.preventDefault();
      show(at + steps[event.key]);
    });
  });

  // Paper shows what is folded away.
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    opened.forEach((one) => { one.open = true; });
  });
  addEventListener("afterprint", () => opened.forEach((one) => { one.open = false; }));
})();
