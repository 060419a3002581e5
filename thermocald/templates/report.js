"use strict";
(function () {
  function copy(button) {
    const range = document.createRange(), selection = window.getSelection();
    range.selectNode(button.closest(".table").querySelector("table"));
    selection.removeAllRanges();
    selection.addRange(range);
    // The old way works for files opened from disk, where the clipboard interface is refused.
    const done = document.execCommand("copy");
    selection.removeAllRanges();
    button.textContent = done ? "Copied" : "Select it and copy";
    window.setTimeout(function () { button.textContent = "Copy table"; }, 2000);
  }

  function readOff(svg, event) {
    // corners of the axes in the drawing's units, then the values there
    const [x0, x1, y0, y1, X0, X1, Y0, Y1] = svg.dataset.scales.split(" ").map(Number);
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const u = (at.x - x0) / (x1 - x0), v = (at.y - y0) / (y1 - y0);
    const inside = u >= 0 && u <= 1 && v >= 0 && v <= 1;
    const place = svg.parentElement.querySelector("output");
    place.textContent = inside ? `${short(X0 + u * (X1 - X0), X1 - X0)}, ${short(Y0 + v * (Y1 - Y0), Y1 - Y0)}` : "";
  }

  function short(value, span) {
    return value.toFixed(Math.max(0, Math.min(8, 3 - Math.floor(Math.log10(Math.abs(span))))));
  }

  document.querySelectorAll("button.copy").forEach(function (button) {
    button.hidden = false;
    button.addEventListener("click", function () { copy(button); });
  });
  document.querySelectorAll(".panel svg").forEach(function (svg) {
    // A click makes a drawing as wide as the page, another one small again.
    svg.addEventListener("click", function () { svg.parentElement.classList.toggle("large"); });
    if (!svg.dataset.scales) return;
    svg.after(document.createElement("output"));
    svg.addEventListener("pointermove", function (event) { readOff(svg, event); });
    svg.addEventListener("pointerleave", function () { svg.nextElementSibling.textContent = ""; });
  });
  window.addEventListener("beforeprint", function () {
    document.querySelectorAll("details").forEach(function (part) { part.open = true; });
  });
  function unfold() {
    const part = location.hash && document.querySelector("details" + location.hash);
    if (part) part.open = true;
  }
  window.addEventListener("hashchange", unfold);
  unfold();
})();
