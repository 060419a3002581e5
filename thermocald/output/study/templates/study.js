"use strict";
(function () {
  const config = { responsive: true, displaylogo: false,
    modeBarButtonsToRemove: ["lasso2d", "select2d", "toImage"] };

  function traces(panel) {
    const result = [];
    for (const c of panel.curves) {
      const line = { color: c.colour, width: 1.4, dash: c.dashed ? "dash" : "solid" };
      if (c.kind === "band") {
        result.push({ x: c.x, y: c.lower, mode: "lines", line: { width: 0 }, hoverinfo: "skip" });
        result.push({ x: c.x, y: c.upper, mode: "lines", line: { width: 0 }, fill: "tonexty",
          fillcolor: c.colour + "33", hoverinfo: "skip" });
      }
      const points = c.kind === "points";
      result.push({ x: c.x, y: c.y, name: c.name, mode: points ? "markers" : "lines", line: line,
        marker: { color: c.colour, size: 4, opacity: 0.75 }, hoverinfo: c.name ? "x+y+name" : "x+y" });
    }
    return result;
  }

  function legend(panels) {
    // One for the figure: in every panel it would cost a third of the height.
    const names = new Map();
    for (const panel of panels) for (const c of panel.curves) if (c.name) names.set(c.name, c);
    const list = document.createElement("ul");
    list.className = "legend";
    if (names.size > 1) {
      for (const [name, c] of names) {
        const item = document.createElement("li");
        item.style.setProperty("--colour", c.colour);
        item.className = c.kind === "points" ? "dot" : c.dashed ? "dashed" : "line";
        item.textContent = name;
        list.appendChild(item);
      }
    }
    return list;
  }

  function layout(panel) {
    const axis = { gridcolor: "#e4e4e4", zeroline: false, automargin: true, exponentformat: "power" };
    const flat = panel.horizontal.map(function (h) {
      return { type: "line", xref: "paper", x0: 0, x1: 1, y0: h[0], y1: h[0],
        line: { color: "#555", width: 1, dash: "dash" } };
    });
    return {
      title: { text: panel.title, x: 0.02, font: { size: 14 } },
      margin: { l: 10, r: 10, t: 34, b: 10 },
      font: { family: "system-ui, sans-serif", size: 11, color: "#1c2024" },
      xaxis: Object.assign({ title: { text: panel.x, standoff: 6 } }, axis),
      yaxis: Object.assign({ title: { text: panel.y, standoff: 6 }, type: panel.log ? "log" : "linear" },
        axis, panel.equal ? { scaleanchor: "x" } : {}),
      shapes: flat, showlegend: false,
    };
  }

  let loading = null;
  function plotly() {
    // The drawing script is packed in the page and unpacked when it is first needed.
    loading = loading || (async function () {
      const packed = atob(document.getElementById("plotly").textContent);
      const bytes = Uint8Array.from(packed, (c) => c.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
      const script = document.createElement("script");
      script.textContent = await new Response(stream).text();
      document.head.appendChild(script);
      return window.Plotly;
    })();
    return loading;
  }

  async function toggle(button) {
    const figure = document.getElementById(button.dataset.figure);
    const still = figure.querySelector(".static"), live = figure.querySelector(".live");
    const opening = live.hidden;
    live.hidden = !opening;
    still.hidden = opening;
    button.textContent = opening ? "Back to the drawing" : "Look closer: zoom and read values";
    if (!opening || live.childElementCount) return;
    let Plotly = null;
    try {
      Plotly = await plotly();
    } catch (error) {
      live.textContent = "This browser is too old to look closer: " + error;
      return;
    }
    live.classList.add(...Array.from(still.classList).filter((name) => name.startsWith("columns")));
    const panels = JSON.parse(figure.querySelector("script.data").textContent);
    live.appendChild(legend(panels));
    for (const panel of panels) {
      const div = document.createElement("div");
      live.appendChild(div);
      Plotly.newPlot(div, traces(panel), layout(panel), config);
    }
  }

  function copy(button) {
    const table = button.closest(".table").querySelector("table");
    const range = document.createRange();
    range.selectNode(table);
    const selection = window.getSelection();
    selection.removeAllRanges();
    selection.addRange(range);
    // The old way works for files opened from disk, where the clipboard interface is refused.
    const done = document.execCommand("copy");
    selection.removeAllRanges();
    button.textContent = done ? "Copied" : "Select it and copy";
    window.setTimeout(function () { button.textContent = "Copy table"; }, 2000);
  }

  document.querySelectorAll("button.closer").forEach(function (button) {
    button.addEventListener("click", function () { toggle(button); });
  });
  document.querySelectorAll("button.copy").forEach(function (button) {
    button.addEventListener("click", function () { copy(button); });
  });
})();
