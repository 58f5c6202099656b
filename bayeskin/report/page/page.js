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
  each("table", (table) => {
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
  each("button.enlarge", (button) => {
    const frame = button.closest("figure").querySelector(".wide");
    if (!frame.firstElementChild) return;
    button.hidden = false;
    button.addEventListener("click", () => {
      home = frame;
      room.setAttribute("role", "img");
      room.setAttribute("aria-label", frame.getAttribute("aria-label"));
      room.append(frame.firstElementChild);
      dialog.showModal();
    });
  });
  dialog.addEventListener("close", () => {
    if (home) home.append(room.firstElementChild);
    home = null;
  });
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());

  // The force's history: the bin under the pointer, or under the cross-hair that the arrow keys move.
  const source = document.getElementById("history-data");
  if (source) {
    const data = JSON.parse(source.textContent);
    const chart = document.getElementById("history");
    const cross = chart.querySelector(".cross");
    const hair = cross.querySelector("line");
    const dot = cross.querySelector("circle");
    const out = document.getElementById("read-out");
    let at = 0;
    const millinewton = (force) => `${(1000 * force).toFixed(1)} mN`.replace("-", "−");
    const show = (bin) => {
      at = Math.min(Math.max(bin, 0), data.x.length - 1);
      const t = data.time_s[at];
      const phase = data.phases.find((one) => t >= one.from && t < one.to);
      const recorded = data.recorded_n[at];
      for (const end of ["x1", "x2"]) hair.setAttribute(end, data.x[at]);
      hair.setAttribute("y1", data.top);
      hair.setAttribute("y2", data.bottom);
      dot.setAttribute("cx", data.x[at]);
      dot.setAttribute("cy", data.y[at]);
      cross.classList.add("on");
      out.textContent = `${t.toFixed(2)} s${phase ? `, ${phase.name}` : ""}: `
        + (recorded === null ? "nothing recorded" : `recorded ${millinewton(recorded)}`)
        + (data.fitted[at] ? "" : " (not fitted)")
        + `; predicted ${millinewton(data.median_n[at])}, 90 % band `
        + `${millinewton(data.low_90_n[at])} to ${millinewton(data.high_90_n[at])}`;
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
  }

  // Paper shows what is folded away.
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    opened.forEach((one) => { one.open = true; });
  });
  addEventListener("afterprint", () => opened.forEach((one) => { one.open = false; }));
})();
