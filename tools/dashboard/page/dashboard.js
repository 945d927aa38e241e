"use strict";
// The page's own script: reads server-sent events, draws the plots as SVG, sends what the buttons ask.
const el = id => document.getElementById(id);
const key = document.querySelector('meta[name="weldcal-key"]').content;
const SILENT_MS = 3500;
let rows = { weld: [], scans: [] };
let last = null, heardAt = Date.now(), over = false;

const show = (id, on) => { const e = el(id); if (e) e.hidden = !on; };
const say = (id, text) => { const e = el(id); if (e && e.textContent !== text) e.textContent = text; };
const fixed = (v, n, unit) => v === null || v === undefined ? "" : v.toFixed(n) + " " + unit;
const duration = s => s < 60 ? Math.round(s) + " s" : Math.floor(s / 60) + " min " + Math.round(s % 60) + " s";

// --- plots ---------------------------------------------------------------------------------------------------------------
function node(name, attributes, text) {
  const e = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const k in attributes) e.setAttribute(k, attributes[k]);
  if (text !== undefined) e.textContent = text;
  return e;
}

// points: [x, y | null]; o: {x: [low, high], y: [low, high], unit, limit, limitName, band: [low, high], dots, places}
function plot(id, points, o) { draw(el(id), [{ points }], o); }

// curves: [{points, colour}]
function draw(svg, curves, o) {
  const W = svg.clientWidth || 320, H = svg.clientHeight || 92;
  const L = 38, R = 6, T = 6, B = 16;
  const X = v => L + (W - L - R) * (v - o.x[0]) / Math.max(o.x[1] - o.x[0], 1e-9);
  const Y = v => T + (H - T - B) * (1 - (Math.min(Math.max(v, o.y[0]), o.y[1]) - o.y[0]) / Math.max(o.y[1] - o.y[0], 1e-9));
  svg.setAttribute("viewBox", `0 0 ${W} ${H}`);
  const parts = [node("rect", { class: "frame", x: L, y: T, width: W - L - R, height: H - T - B })];
  if (o.band) {
    const top = Y(Math.min(o.band[1], o.y[1])), low = Y(Math.max(o.band[0], o.y[0]));
    parts.push(node("rect", { class: "band", x: L, y: top, width: W - L - R, height: Math.max(low - top, 1) }));
  }
  for (const v of [o.y[0], o.y[1]]) {
    parts.push(node("text", { x: L - 4, y: Y(v) + 4, "text-anchor": "end" }, v.toFixed(o.places)));
  }
  parts.push(node("text", { x: L, y: H - 3 }, o.x[0].toFixed(0)));
  parts.push(node("text", { x: W - R, y: H - 3, "text-anchor": "end" }, o.x[1].toFixed(0) + " " + o.unit));
  if (o.limit !== undefined && o.limit !== null) {
    parts.push(node("line", { class: "limit", x1: L, x2: W - R, y1: Y(o.limit), y2: Y(o.limit) }));
    if (o.limitName) parts.push(node("text", { class: "limitname", x: W - R - 4, y: Y(o.limit) - 4, "text-anchor": "end" }, o.limitName));
  }
  for (const curve of curves) {
    const colour = curve.colour && curve.colour !== "line" ? " " + curve.colour : "";
    let path = "", pen = false;
    for (const [x, y] of curve.points) {
      if (y === null || y === undefined) { pen = false; continue; }
      path += (pen ? "L" : "M") + X(x).toFixed(1) + " " + Y(y).toFixed(1);
      pen = true;
      if (o.dots) parts.push(node("circle", { class: "dot" + colour, cx: X(x), cy: Y(y), r: 3.5 }));
    }
    if (path && o.line !== false) parts.push(node("path", { class: "curve" + colour, d: path }));
  }
  svg.replaceChildren(...parts);
}

const nice = v => { const e = Math.pow(10, Math.floor(Math.log10(Math.max(v, 1e-6)))); return [1, 2, 5, 10].map(k => k * e).find(k => k >= v - 1e-12); };
const largest = (points, least) => points.reduce((m, p) => p[1] === null ? m : Math.max(m, Math.abs(p[1])), least);

// Columns of a row of the weld: time, torch and tip along the seam, and the three that are drawn.
const TORCH = 1, TIP = 2, OFFSET = 3, DEFLECTION = 4, SPEED = 5;

function drawn(along, column, length) {
  const on = rows.weld.filter(r => r[along] !== null && r[along] >= 0 && r[along] <= length);
  const step = Math.max(1, Math.floor(on.length / 500));
  return on.filter((_, k) => k % step === 0 || k === on.length - 1).map(r => [r[along], r[column]]);
}

const known = {};  // of a weld that is over

function drawWeld(v) {
  known.length = v.weld ? v.weld.length_mm : known.length || Math.max(1, ...rows.weld.slice(-1).map(r => r[1] || 1));
  const length = known.length, x = [0, length], limits = v.limits;
  const offset = drawn(TORCH, OFFSET, length), deflection = drawn(TIP, DEFLECTION, length), speed = drawn(TORCH, SPEED, length);
  const reach = Math.max(0.5, nice(largest(offset, 0.1)));
  plot("plot_offset", offset, { x, y: [-reach, reach], unit: "mm of seam", places: 1, limit: 0, limitName: "plan" });
  const wanted = limits.deflection || known.wanted, band = limits.band || known.band, target = limits.speed || known.target;
  [known.wanted, known.band, known.target] = [wanted, band, target];
  plot("plot_deflection", deflection, { x, y: [0, wanted ? 2 * wanted : 3], unit: "mm of seam", places: 1, limit: wanted, limitName: wanted ? "wanted " + wanted.toFixed(1) : "", band });
  plot("plot_speed", speed, { x, y: [0, target ? 2 * target : 20], unit: "mm of seam", places: 0, limit: target, limitName: target ? "wanted " + target.toFixed(1) : "" });
}

function drawScans(c) {
  const points = rows.scans.map(r => [r[0], r[1]]);
  const high = nice(Math.max(2 * c.required_mm, Math.min(largest(points, 0), 20 * c.required_mm)));
  plot("plot_error", points, { x: [0, Math.max(c.maximum, c.scans, 1)], y: [0, high], unit: "scans", places: 2, dots: true, limit: c.required_mm, limitName: "required " + c.required_mm.toFixed(2) + " mm" });
}

// --- the scene: cameras, legend -----------------------------------------------------------------------------------------
function element(name, text, className) {
  const e = document.createElement(name);
  if (text) e.textContent = text;
  if (className) e.className = className;
  return e;
}

const drawnOf = {};  // what was last drawn of a part, so that it is drawn anew only where it changed
const changed = (part, value) => { const text = JSON.stringify(value); if (drawnOf[part] === text) return false; drawnOf[part] = text; return true; };

function scene(v) {
  const s = v.scene;
  if (!el("over")) return;
  if (el("cameras") && changed("cameras", [s.cameras, s.wanted, s.showing, v.can.end])) {
    el("cameras").replaceChildren(...s.cameras.map(c => {
      const b = element("button", c.name);
      b.type = "button";
      b.dataset.key = c.key;
      b.setAttribute("aria-pressed", String(s.wanted === c.key));
      if (s.wanted === "follow" && s.showing === c.key) b.className = "showing";
      b.addEventListener("click", () => ask("camera-" + c.key));
      return b;
    }));
    show("cameras", s.cameras.length > 0 && v.can.end);
    show("moved", s.wanted === "moved" && v.can.end);
  }
  if (changed("keys", [s.legend, s.scale_mm])) {
    el("keys").replaceChildren(...s.legend.map(k => {
      const row = element("div"), i = element("i", "", k.style);
      if (k.style === "area") i.style.background = k.colour; else i.style.borderTopColor = k.colour;
      row.append(i, k.text);
      return row;
    }));
    if (s.scale_mm !== null) {
      const row = element("div", "", "scale"), ends = element("span", "", "ends");
      ends.append(...["-" + s.scale_mm, "0", "+" + s.scale_mm].map(t => element("span", t)));
      row.append("Flange face beside the calibration, mm", element("i"), ends);
      el("keys").append(row);
    }
  }
  show("keys", s.legend.length > 0 && !v.replay);
  const doing = v.state === "HELD" ? "held" : v.state === "RUNNING" ? v.line : "";
  show("over", doing !== "");
  say("over_phase", doing);
  const w = v.weld, c = v.calibration, figures = [];
  if (w) {
    figures.push(w.at_mm.toFixed(0) + " of " + w.length_mm.toFixed(0) + " mm");
    if (w.deflection_mm !== null) figures.push("deflection " + w.deflection_mm.toFixed(2) + " mm");
    if (w.speed_mm_s !== null) figures.push("torch " + w.speed_mm_s.toFixed(1) + " mm/s");
  } else if (c && c.error_mm !== null && s.scale_mm !== null) figures.push(c.error_mm.toFixed(2) + " mm expected at the work point");
  say("over_figures", figures.join(", "));
}

// --- jobs besides the weld: what the program lists -----------------------------------------------------------------------
function panel(v) {
  const p = v.panel;
  show("panel", !!p);
  if (!p) return;
  say("panel_heading", p.heading);
  say("panel_note", p.note);
  show("panel_warning", !!p.warning);
  say("panel_warning", p.warning || "");
  if (changed("panel_titles", p.plots.map(q => q.title))) {
    el("panel_plots").replaceChildren(...p.plots.map(q => {
      const figure = element("figure"), caption = element("figcaption", q.title);
      const svg = node("svg", { role: "img", "aria-label": q.title + " over " + q.unit });
      if (q.curves.length > 1) {
        const curves = element("span", "", "curves");
        for (const c of q.curves) { const one = element("span"); one.append(element("i", "", c.colour), c.name); curves.append(one); }
        caption.append(curves);
      }
      caption.append(element("b"));
      figure.append(caption, svg);
      return figure;
    }));
    drawnOf.panel_plots = "";
  }
  if (changed("panel_plots", [p.plots, innerWidth])) p.plots.forEach((q, k) => {
    const figure = el("panel_plots").children[k];
    figure.querySelector("b").textContent = q.now;
    draw(figure.querySelector("svg"), q.curves, { x: q.x, y: q.y, unit: q.unit, places: q.places, dots: q.dots, line: q.line, limit: q.limit, limitName: q.limit_name });
  });
  if (changed("panel_lines", p.lines)) {
    el("panel_lines").replaceChildren(...p.lines.flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  }
}

let pictured = 0;
function picture(v) {
  const img = el(v.panel ? "picture_panel" : "picture_calibration");
  if (v.picture && v.picture !== pictured && !v.closing) { pictured = v.picture; img.src = "picture/" + v.picture; }
  img.onload = () => { img.hidden = false; };
  img.onerror = () => { img.hidden = true; };
}

// --- the result ----------------------------------------------------------------------------------------------------------
// The recording and the report are loaded while the program still serves them, so that they stay when it has ended.
const PAGE_NAMES = { "recording.html": "Replay", "report.html": "Report" };
const loaded = {};
let chosen = "";

function choose(name) {
  chosen = name;
  for (const [other, frame] of Object.entries(loaded)) frame.hidden = other !== name;
  show("live_view", !loaded[name]);
  if (loaded[name]) loaded[name].contentWindow.dispatchEvent(new Event("resize"));
  show("replay", name !== "report.html");
  for (const b of el("pages").children) b.setAttribute("aria-pressed", String(b.dataset.key === name));
}

function load(name) {
  const frame = element("iframe");
  frame.title = PAGE_NAMES[name];
  frame.hidden = true;
  frame.onload = () => {
    let body = null;
    try { body = frame.contentDocument && frame.contentDocument.body; } catch { return; }
    if (!body || !body.childElementCount) return;
    loaded[name] = frame;
    const b = element("button", PAGE_NAMES[name]);
    b.type = "button"; b.dataset.key = name;
    b.addEventListener("click", () => choose(name));
    if (name === "recording.html") el("pages").prepend(b); else el("pages").append(b);
    show("pages", true);
    choose(name === "recording.html" || !chosen ? "recording.html" : chosen);
  };
  frame.src = "result/" + name;
  document.querySelector(".view").append(frame);
}

function result(v) {
  const r = v.result;
  show("result", !!r);
  if (!r || !changed("result", r)) return;
  say("verdict", r.verdict || "");
  el("verdict").className = r.tone;
  say("reason", r.reason);
  el("result_rows").replaceChildren(...r.rows.flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  say("result_folder", r.folder ? "All files are in " + r.folder + ". To open the report later: weldcal view " + r.folder : "");
  if (el("pages") && !v.closing) r.files.forEach(load);
}

// --- values --------------------------------------------------------------------------------------------------------------
function update(v) {
  last = v;
  document.body.dataset.state = v.state;
  say("state", v.state);
  say("line", v.line);
  say("title", v.title || "weldcal");
  say("robot", v.robot);
  document.title = v.state + " - weldcal";
  show("replay", v.replay);
  for (const name of ["hold", "go_on", "end"]) if (el(name)) el(name).disabled = !v.can[name];
  if (!v.can.end) unsure();
  el("bar").style.width = (100 * v.share).toFixed(1) + "%";
  say("clock", v.wall_s > 0 ? duration(v.wall_s) + (v.can.end ? " so far" : "") : "");
  say("left", v.left_s === null ? "" : "about " + duration(v.left_s) + " left");
  el("steps").replaceChildren(...v.steps.map(s => {
    const li = document.createElement("li");
    li.className = s.is;
    li.textContent = s.name;
    if (s.is === "now") li.setAttribute("aria-current", "step");
    return li;
  }));
  document.querySelector(".view").classList.toggle("ended", v.replay);
  if (chosen) show("replay", v.replay && chosen !== "report.html");
  result(v);
  scene(v);
  panel(v);
  picture(v);
  const w = v.weld, c = v.calibration;
  if (w || rows.weld.length) {
    show("welding", true);
    if (!w) {
      for (const name of ["seam", "offset", "deflection", "speed", "beside"]) say(name, "");
      show("margin", false);
    } else {
      say("seam", w.at_mm.toFixed(0) + " of " + w.length_mm.toFixed(0) + " mm" + (w.torch_on ? ", torch on" : ", torch off"));
      say("offset", fixed(w.offset_mm, 2, "mm"));
      say("beside", w.beside_mm === null ? "" : "The torch is " + Math.abs(w.beside_mm).toFixed(2) + " mm beside the seam that the tip has felt.");
      say("deflection", fixed(w.deflection_mm, 2, "mm"));
      say("speed", fixed(w.speed_mm_s, 1, "mm/s"));
      show("margin", w.margin_percent !== null);
      say("margin", "Steering margin " + w.margin_percent + " %: the arm is near a singular position and will slow down, then stop.");
    }
    drawWeld(v);
  }
  const welding = !!(w || rows.weld.length);
  if (c && (c.scans > 0 || c.next)) {
    show("calibrating", true);
    say("scans", c.scans + (c.scans === 1 ? " scan" : " scans"));
    say("error", fixed(c.error_mm, 2, "mm"));
    say("last_scan", c.last || "none yet");
    show("next_name", !!c.next);
    say("next_pose", c.next || "");
    if (!welding) el("welding").before(el("calibrating")); else el("welding").after(el("calibrating"));
    drawScans(c);
  }
  say("pace_now", v.pace.now === null || v.state === "HELD" ? "" : v.pace.now.toFixed(2) + " of real time");
  if (el("pace")) {
    show("pace_label", v.can.pace);
    el("pace").disabled = !v.can.pace;
    if (document.activeElement !== el("pace")) { el("pace").value = v.pace.asked; sayPace(v.pace.asked); }
  }
  show("pace_part", !over && !v.replay && (v.can.pace || v.pace.now !== null));
}

function sayPace(x) { say("pace_asked", x > 0 ? "at most " + Number(x).toFixed(1) + " of real time" : "as fast as it goes"); }

function silent() {
  if (over || Date.now() - heardAt < SILENT_MS) return;
  document.body.dataset.state = "NO CONNECTION";
  say("state", "NO CONNECTION");
  say("line", "The program does not answer. What the arm does is not known here: look at the arm.");
  for (const name of ["hold", "go_on", "end", "pace"]) if (el(name)) el(name).disabled = true;
}

// --- buttons -------------------------------------------------------------------------------------------------------------
function ask(what, value) {
  return fetch("act/" + what, {
    method: "POST",
    headers: { "X-Weldcal-Key": key, "Content-Type": "application/json" },
    body: JSON.stringify(value === undefined ? {} : { value: Number(value) }),
  });
}

let sureUntil = 0;
function unsure() { sureUntil = 0; if (el("end")) { el("end").classList.remove("sure"); say("end", "End"); } }

if (key) {
  el("hold").addEventListener("click", () => ask("hold"));
  el("go_on").addEventListener("click", () => ask("go_on"));
  el("end").addEventListener("click", () => {
    if (Date.now() < sureUntil) { unsure(); ask("end"); return; }
    sureUntil = Date.now() + 4000;
    el("end").classList.add("sure");
    say("end", "Really end?");
    setTimeout(() => { if (Date.now() >= sureUntil) unsure(); }, 4100);
  });
  el("pace").addEventListener("input", () => sayPace(el("pace").value));
  el("pace").addEventListener("change", () => { ask("pace", el("pace").value); el("pace").blur(); });
  document.addEventListener("keydown", e => { if (e.key === "Escape" && !el("hold").disabled) ask("hold"); });
}

const events = new EventSource("events");
events.onopen = () => { rows = { weld: [], scans: [] }; };
events.onmessage = message => {
  const v = JSON.parse(message.data);
  heardAt = Date.now();
  rows.weld.push(...v.rows.weld);
  rows.scans.push(...v.rows.scans);
  if (v.closing && !over) { over = true; events.close(); setInterval(another, 3000); }
  update(v);
};
// When the run is over its program ends; the next run is served at the same address.
const another = () => fetch("values").then(found => { if (found.ok) location.reload(); }, () => {});
setInterval(silent, 500);
addEventListener("resize", () => { if (last) update(last); });
