"use strict";
// The capture page: shows the session from server-sent events, and sends what the buttons ask.
const el = id => document.getElementById(id);
const key = document.querySelector('meta[name="weldcal-key"]').content;
const SILENT_MS = 3500;
let heardAt = Date.now(), pictured = 0, last = null;

const say = (id, text) => { const e = el(id); if (e.textContent !== text) e.textContent = text; };
const show = (id, on) => { el(id).hidden = !on; };
const ask = (what, value) => fetch("act/" + what, { method: "POST", headers: { "Content-Type": "application/json", "X-Weldcal-Key": key }, body: JSON.stringify({ value }) })
  .then(answer => { if (answer.status === 403) location.reload(); });  // the program was started anew: its key is another one
const capture = () => { if (!el("capture").disabled) ask("capture", el("pose").value); };

function list(id, items, back) {
  const text = JSON.stringify([items, !!back]);
  if (el(id).dataset.shown === text) return;
  el(id).dataset.shown = text;
  el(id).replaceChildren(...items.map(([words, odd]) => { const li = document.createElement("li"); li.textContent = words; if (odd) li.className = "odd"; return li; }));
  if (back) [...el(id).children].forEach((li, k) => {
    const b = document.createElement("button");
    b.type = "button"; b.className = "small"; b.textContent = "take back"; b.addEventListener("click", () => back(k));
    li.append(" ", b);
  });
}

function shown(v) {
  const busy = v.state !== "READY", one = v.last;
  document.body.dataset.state = v.state === "READY" ? "DONE" : "RUNNING";
  say("title", v.title);
  say("arm", v.arm === v.sensor ? v.arm : v.arm + ", " + v.sensor);
  const bad = v.problem || (one && one.refused) || "", good = v.error_mm !== null && v.error_mm <= v.required_mm && !v.used;
  say("state", bad && !busy ? "NOT TAKEN" : v.state);
  if (bad && !busy) document.body.dataset.state = "HELD";
  el("line").className = bad ? "bad" : "";
  say("line", bad || (one && !busy ? "Taken: " + (v.used ? "check " : "") + one.id + "." + (good ? " The error is as low as is wanted: press Use it." : "") : v.state === "TAKING" && v.waits ? "Scan now: a new file is waited for." : busy ? "" : v.used ? "Written to " + v.result + ". Capture elsewhere: it judges the result." : "Bring the arm into a new pose, and capture."));
  show("typed", v.typed);
  show("auto", !v.typed);
  el("by_itself").checked = v.by_itself;
  el("capture").disabled = busy;
  el("use").disabled = busy || v.used || v.matrix === null;
  el("back").disabled = busy || v.used || !v.captures.length;
  if (v.picture && v.picture !== pictured) { pictured = v.picture; el("picture").src = "picture/" + v.picture; el("picture").hidden = false; }
  say("gain", v.gain === null ? "" : (100 * v.gain).toFixed(0) + " % less uncertainty");
  say("advice", v.advice || (v.used ? "Any other pose judges the result." : v.hint));
  say("ur_pose", v.ur_pose || "");
  say("error", v.error_mm === null ? "not yet known" : v.error_mm.toFixed(2) + " mm with 95 %, wanted " + v.required_mm.toFixed(2));
  el("bar").style.width = v.error_mm === null ? "0" : Math.min(100, 100 * v.required_mm / v.error_mm) + "%";
  show("matrix", v.matrix !== null);
  if (v.matrix) say("matrix", v.symbol + " =\n" + v.matrix.map(r => r.map(x => x.toFixed(6).padStart(10)).join(" ")).join("\n"));
  list("said", v.said.map(t => [t, false]));
  say("count", String(v.captures.length));
  list("captures", v.captures.map(c => [c.id + (c.odd ? ": " + c.odd : ""), !!c.odd]), v.used ? null : k => ask("back-" + v.captures[k].id));
  show("checking", v.used);
  list("checks", v.checks.map(c => [c.error_mm.toFixed(3) + " mm, wanted " + v.required_mm.toFixed(2), c.error_mm > v.required_mm]));
  say("folder", v.used ? v.result : v.folder);
  say("command", v.command);
  if (v.jogs.length && !el("jogs").children.length) {
    for (const name of v.jogs) {
      const b = document.createElement("button");
      b.type = "button"; b.textContent = name.includes("r") ? "turn " + name.replace("r", "") : name; b.addEventListener("click", () => ask("jog-" + name));
      el("jogs").append(b);
    }
    const go = document.createElement("button");
    go.type = "button"; go.id = "go"; go.textContent = "to the next pose"; go.style.gridColumn = "1 / -1"; go.addEventListener("click", () => ask("jog-next"));
    el("jogs").append(go);
  }
  show("jogs", v.jogs.length > 0);
  show("steps", v.jogs.length > 0);
  if (v.jogs.length) say("steps", v.jogs[0].includes("J") ? "Steps of 15 deg." : "Steps of 50 mm and 15 deg, along and about the base's axes.");
  if (el("go")) el("go").disabled = busy || !v.advice;
  last = v;
}

el("capture").addEventListener("click", capture);
el("use").addEventListener("click", () => ask("use"));
el("back").addEventListener("click", () => { if (last && last.captures.length) ask("back-" + last.captures[last.captures.length - 1].id); });
el("by_itself").addEventListener("change", () => ask("by_itself"));
document.addEventListener("keydown", e => {
  if (e.code === "Space" && e.target.tagName !== "INPUT") { e.preventDefault(); if (!e.repeat) capture(); }
  if (e.code === "Enter" && e.target.id === "pose") capture();
});
document.addEventListener("keyup", e => { if (e.code === "Space" && e.target.tagName === "BUTTON") e.preventDefault(); });
const events = new EventSource("events");
events.onmessage = e => { heardAt = Date.now(); const v = JSON.parse(e.data); if (v.closing) events.close(); shown(v); };
setInterval(() => { if (Date.now() - heardAt > SILENT_MS) { say("state", "NO CONNECTION"); document.body.dataset.state = "NO CONNECTION"; for (const b of document.querySelectorAll("button")) b.disabled = true; } }, 500);
