// The page: the daemon's status as a stream, the last epoch of one camera, its time series from the store.
"use strict";
const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
// As in the reports: colours for every kind of colour vision, bands of 95 %.
const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"], BAND = 1.96;
const COURSE_EVERY_MS = 10000, RESIDUAL_SCALE = 400;
let status = {}, series = [], shownEpoch = null, courseAt = 0, eventsAt = 0, courses = 0, lastUtc = 0;

async function get(path) {
  const answer = await fetch(path, { headers: { accept: "application/json" } });
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

function rows(target, content) { $(target).replaceChildren(...content); }

function fixed(value, digits) {
  return value === null || value === undefined ? "–" : Number(value).toFixed(digits).replace("-", "−");
}

function measured(value, digits, unit) {
  const number = fixed(value, digits);
  return number === "–" ? number : `${number} ${unit}`;
}

function counted(count, noun) { return `${count} ${noun}${count === 1 ? "" : "s"}`; }

function time(utc) {
  return new Date(utc * 1000).toISOString().replace("T", " ").slice(0, 19);
}

function options(select, names) {
  const before = select.value;
  if (names.join("\n") === [...select.options].map((o) => o.value).join("\n")) return;
  select.replaceChildren(...names.map((n) => new Option(n, n)));
  if (names.includes(before)) select.value = before;
}

function show(document_) {
  if (document_.pid) lastUtc = document_.utc;
  status = document_;
  fillCameras();
  showCamera((status.cameras || {})[chosen()]);
  connected(!status.pid ? ended() : status.age_s > 10 ?
    `the daemon has not answered since ${time(status.utc)} UTC` : "live");
  showDevices();
  showWarnings();
  if (status.pid) {
    $("foot").textContent = `thermocald ${status.version}, since ${time(status.started)} UTC; ` +
      `store ${status.store.path}`;
  }
  if (Date.now() - courseAt > COURSE_EVERY_MS) refreshCourse();
  if (Date.now() - eventsAt > COURSE_EVERY_MS) refreshEvents();
}

function connected(text) {
  $("connection").textContent = text;
  if (text === "live") return;
  $("state").textContent = `${text}; stored data are shown below`;
  $("state").className = status.pid ? "failed" : "";
}

function ended() {
  const since = status.stopped || lastUtc;
  return since ? `acquisition has stopped: no daemon has run since ${time(since)} UTC` : "no daemon is running";
}

// The camera whose figures, frame and curves are shown; data of other cameras are discarded.
function chosen() { return $("camera").value; }

function fillCameras() {
  const names = [...Object.keys(status.cameras || {}), ...series.map((s) => s.camera).reverse()];
  $("camera").parentElement.hidden = !names.length;
  if (names.length) options($("camera"), [...new Set(names)]);
}

function noCamera() {
  if (chosen()) return `this daemon does not have camera ${chosen()}; its stored data are shown below`;
  return status.pid ? "this daemon has no camera; its thermometers are listed under Devices" : "nothing is stored yet";
}

// What a camera does now, in words, and its class of CSS.
function verdict(camera, last) {
  if (["out", "failed", "hung"].includes(camera.device)) return [`${camera.device}: ${camera.why || "it does not answer"}`, "failed"];
  if (last.epoch === undefined) {
    return [!camera.device ? noCamera() : camera.series === "" ? "idle until a session begins" : "no epoch yet", ""];
  }
  if (["ok", "predicted", "resected", "last_pose"].includes(last.status)) return [last.online?.sentence || last.state, last.state];
  return [last.status.replaceAll("_", " ") + (last.reason ? `: ${last.reason}` : ""),
    last.status === "not_calibrated" ? "drifting" : "failed"];
}

function showCamera(camera) {
  const last = (camera && camera.last) || {}, online = last.online || {};
  const [text, className] = verdict(camera || {}, last);
  if ($("state").textContent !== text) $("state").textContent = text;
  $("state").className = className;
  if (last.epoch === undefined) { rows("figures", []); return; }
  const figures = [["Epoch", String(last.epoch), time(last.frame_time) + " UTC"],
    ["Temperature", measured(last.temperature, 2, "°C"), ""]];
  for (const [name, label] of [["c", "c"], ["x0", "x₀"], ["y0", "y₀"]]) {
    const sd = online["sd_" + name] ?? last["sd_" + name];
    figures.push([label, measured(online[name] ?? last[name], 5, "mm"),
      (sd ? `±\u00a0${fixed(sd, 5)}` : "") + (sd && last["sd_" + name] ?
        `; this epoch alone ${fixed(last[name], 5)} ±\u00a0${fixed(last["sd_" + name], 5)}` : "")]);
  }
  figures.push(["σ₀", fixed(last.sigma0, 3), `${counted(last.n_observations, "target")}, ${last.n_rejected} rejected`]);
  if (online.orientation) figures.push(["Camera", online.orientation, ""]);
  const session = (status.sessions || {})[chosen()];
  if (session) figures.push(["Session", `${session.series}: ${session.taken} of ${session.epochs} epochs, ${session.state}${session.why && ":"}`, session.why]);
  rows("figures", figures.flatMap(([name, value, more]) => {
    const dd = element("dd", value + " ");
    dd.append(element("small", more));
    return [element("dt", name), dd];
  }));
  const key = `${chosen()}/${last.epoch}`;
  if (key !== shownEpoch) { shownEpoch = key; showFrame(chosen()); }
}

async function showFrame(name) {
  let epoch;
  try {
    epoch = await get(`api/cameras/${encodeURIComponent(name)}/epoch`);
    // the size of its image, without which the targets would be drawn elsewhere
    if (!series.some((s) => s.camera === name)) series = await get("api/series");
  } catch { if (!epoch) return; }
  if (name !== chosen()) return;
  const targets = epoch.targets || {}, found = series.findLast((s) => s.camera === name);
  const overlay = $("overlay");
  if (found) overlay.setAttribute("viewBox", `0 0 ${found.width_px} ${found.height_px}`);
  const width = found ? found.width_px : 1000, parts = [];
  (targets.x || []).forEach((x, i) => {
    const y = targets.y[i], dot = document.createElementNS(SVG, "circle");
    const colour = targets.rejected[i] ? "#ff5d52" : "#43d17c";
    Object.entries({ cx: x, cy: y, r: width / 200, stroke: colour }).forEach(([k, v]) => dot.setAttribute(k, v));
    parts.push(dot);
    if (targets.vx[i] === null) return;
    const line = document.createElementNS(SVG, "line");
    Object.entries({ x1: x, y1: y, x2: x + targets.vx[i] * RESIDUAL_SCALE,
      y2: y + targets.vy[i] * RESIDUAL_SCALE, stroke: "#ffc53d" })
      .forEach(([k, v]) => line.setAttribute(k, v));
    parts.push(line);
  });
  overlay.replaceChildren(...parts);
  const count = (targets.x || []).length, bad = (targets.rejected || []).filter(Boolean).length;
  const text = `epoch ${epoch.row.epoch}: ${counted(count, "target")}, ${bad} rejected (red); residuals ×${RESIDUAL_SCALE} (yellow)`;
  $("frame-caption").textContent = text;
  overlay.setAttribute("aria-label", text);
  const picture = await fetch(`api/cameras/${encodeURIComponent(name)}/frame`).catch(() => null);
  const frame = $("frame");
  if (!picture || !picture.ok || name !== chosen()) return;
  const url = URL.createObjectURL(await picture.blob());
  frame.onload = () => URL.revokeObjectURL(url);
  frame.src = url;
  frame.hidden = false;
  frame.alt = `the last frame of camera ${name}`;
}

function showDevices() {
  const content = [];
  for (const kind of ["cameras", "thermometers", "outputs"]) {
    for (const [name, device] of Object.entries(status[kind] || {})) {
      const row = element("tr"), state = element("td");
      const idle = device.device === "closed" && device.series === "";
      const good = idle || ["open", "finished"].includes(device.device);
      state.append(element("span", idle ? "idle" : device.device, good ? "ready" : "failed"),
        (device.since ? ` since ${time(device.since)} UTC` : "") + (device.why ? `: ${device.why}` : ""));
      const now = kind !== "cameras" ? Object.entries((good && device.last) || {})
        .map(([channel, celsius]) => `${channel} ${measured(celsius, 2, "°C")}`).join(", ") :
        (good && !idle ? `${verdict(device, device.last)[0]}; ` : "") + `every ${device.period_s} s, ` +
        `99 % at most ${fixed(1000 * device.late_p99_s, 0)} ms late, ${device.skipped} skipped, ${device.lost} lost, ` +
        `${Math.max(device.deferred - device.caught_up, 0)} to calibrate later`;
      const first = element("th", name);
      first.scope = "row";
      row.append(first, state, element("td", now));
      content.push(row);
    }
  }
  rows("devices", content);
}

function showWarnings() {
  const text = (status.warnings || []).join("\n");
  if ($("warnings").textContent !== text) $("warnings").textContent = text;
}

async function refreshEvents() {
  eventsAt = Date.now();
  try {
    const events = await get("api/events");
    rows("events", events.slice(0, 100).map((event) => {
      const row = element("tr");
      row.append(element("td", time(event.utc)), element("td", event.text));
      return row;
    }));
  } catch { /* there is no store yet; tried again soon */ }
}

async function refreshCourse() {
  const course = ++courses;
  courseAt = Date.now();
  try {
    series = await get("api/series");
    if (course !== courses) return;
    fillCameras();
    options($("series"), series.filter((s) => s.camera === chosen()).map((s) => s.series).reverse());
    for (const id of ["bar", "course"]) $(id).hidden = !$("series").value;
    if (!$("series").value) {
      $("course-note").textContent = chosen() ? `no epoch of camera ${chosen()} is stored yet` : "there is no series yet";
      Plotly.purge("course");
      return;
    }
    const query = new URLSearchParams({ camera: chosen(), series: $("series").value, points: "1500" });
    $("download").href = `api/series.csv?${query}`;
    const span = document.querySelector("input[name=span]:checked").value;
    if (span) query.set("last", span);
    const columns = await get(`api/columns?${query}`);
    if (course === courses) draw(columns, `${query.get("camera")}/${query.get("series")}`);
  } catch (error) { if (course === courses) $("course-note").textContent = "not available now"; }
}

function draw(columns, name) {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  // an interruption is a gap; a Date would be drawn in local time
  const t = columns.frame_time, steps = t.slice(1).map((v, k) => v - t[k]).sort((a, b) => a - b);
  const longest = 4 * steps[steps.length >> 1];
  const cut = (values) => values.flatMap((v, k) => k && t[k] - t[k - 1] > longest ? [null, v] : [v]);
  const x = cut(t.map((v) => new Date(v * 1000).toISOString().slice(0, 23)));
  const traces = [], layout = {
    margin: { l: 70, r: 15, t: 36, b: 55 }, colorway: PALETTE, showlegend: columns.channels.length > 1,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", uirevision: "same",
    font: { color: colour("--ink") }, legend: { orientation: "h", y: 1.04, x: 0 },
    xaxis: { title: { text: "UTC" }, gridcolor: colour("--line"), nticks: innerWidth < 600 ? 4 : 10, tickangle: 0 }, hovermode: "x",
  };
  const panels = [[columns.channels, "°C"], [["c"], "c in mm"], [["x0"], "x₀ in mm"], [["y0"], "y₀ in mm"],
    [["sigma0"], "σ₀ (no unit)"]].filter(([names]) => names.length), step = 1.025 / panels.length;
  layout.xaxis.anchor = `y${panels.length}`;
  panels.forEach(([names, title], i) => {
    const axis = i ? `y${i + 1}` : "y", top = 1 - i * step;
    layout[i ? `yaxis${i + 1}` : "yaxis"] = { title: { text: title, standoff: 10 }, automargin: true, domain: [Math.max(top - step + 0.025, 0), top],
      gridcolor: colour("--line"), zeroline: false, tickformat: title.endsWith("mm") ? ".4f" : "" };
    for (const name of names) {
      const y = cut(columns[name]), sd = columns["sd_" + name] && cut(columns["sd_" + name]);
      if (sd) {
        const above = [], band = { x: [], y: [] };  // one polygon for each run of results
        [...y, null].forEach((v, k) => {
          if (v !== null) { above.push(k); return; }
          const below = [...above].reverse();
          band.x.push(...[...above, ...below].map((n) => x[n]), null);
          band.y.push(...above.map((n) => y[n] + BAND * sd[n]), ...below.map((n) => y[n] - BAND * sd[n]), null);
          above.length = 0;
        });
        traces.push({ ...band, yaxis: axis, type: "scatter", mode: "lines", line: { width: 1, color: "rgba(0,114,178,.2)" }, fill: "toself",
          fillcolor: "rgba(0,114,178,.2)", hoverinfo: "skip", showlegend: false });
      }
      const line = names.length > 1 ? { width: 1.5 } : { width: 1.5, color: PALETTE[0] };
      traces.push({ x, y, yaxis: axis, name, type: "scatter", marker: { size: 4 },
        mode: x.length > 200 ? "lines" : "lines+markers", // a single epoch is a point
        showlegend: names.length > 1, line });
    }
  });
  Plotly.react("course", traces, layout, { responsive: true, displaylogo: false });
  // isolated: a name from right to left would exchange it with the numbers
  $("course-note").replaceChildren(element("bdi", name), `: ${counted(columns.epochs, "epoch")}` +
    (columns.per_point > 1 ? `, up to ${columns.per_point} averaged per point` : "") +
    (columns.unset ? `; ${counted(columns.unset, "epoch")} from before the clock was set not shown` : "") +
    "; bands: 95 % uncertainty of a single epoch");
}

function listen() {
  const stream = new EventSource("api/stream");
  stream.onmessage = (message) => show(JSON.parse(message.data));
  stream.onerror = () => {
    if (!courseAt) { refreshCourse(); refreshEvents(); }
    connected(status.pid ? "the page's server does not answer; trying again" :
      `${ended()}; the page's server has stopped too`);
  };
}

$("camera").addEventListener("change", () => {
  shownEpoch = null;
  $("frame").hidden = true;
  $("overlay").replaceChildren();
  $("frame-caption").textContent = "no frame from a running daemon yet";
  show(status);
  refreshCourse();
});
$("series").addEventListener("change", refreshCourse);
$("range").addEventListener("change", refreshCourse);
// for printing: A4 less margins, in px of CSS
addEventListener("beforeprint", () => { if ($("course").data) Plotly.relayout("course", { width: 670, height: 430, "font.size": 9 }); });
addEventListener("afterprint", () => { if ($("course").data) refreshCourse(); });
for (const look of ["(prefers-color-scheme: dark)", "(max-width: 600px)"]) {
  matchMedia(look).addEventListener("change", refreshCourse);
}
listen(); // its first message, which names the cameras, fetches the rest
