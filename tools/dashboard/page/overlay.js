"use strict";
// The overlay of a recording: reads the time of Meshcat's player, says what happens then, and places the camera unless it was moved.
{
  const el = id => document.getElementById(id);
  let wanted = "follow", shown = "", at = -1, keysOf = null;
  const newest = (rows, t) => { let found = null; for (const r of rows) { if (r[0] > t + 1e-6) break; found = r; } return found; };
  const buttons = [["follow", "Follow the job"], ...run.cameras];
  const say = (id, text) => { if (el(id).textContent !== text) el(id).textContent = text; };

  function mark() {
    for (const b of el("w-cameras").children) b.setAttribute("aria-pressed", String(b.dataset.key === wanted));
  }
  if (run.cameras.length > 1) for (const [key, name] of buttons) {
    const b = document.createElement("button");
    b.textContent = name; b.dataset.key = key; b.type = "button";
    b.addEventListener("click", () => { wanted = key; shown = ""; mark(); });
    el("w-cameras").append(b);
  }
  mark();
  viewer.controls.addEventListener("start", () => { wanted = "moved"; mark(); });

  function place(t) {
    if (wanted === "moved" || !run.places.length) return;
    let p = newest(run.places, t) || run.places[0];
    if (wanted !== "follow" && p[1] !== wanted) {
      const own = run.places.filter(q => q[1] === wanted);
      p = newest(own, t) || own[0];
      if (!p) return;
    }
    const key = p.join();
    if (key === shown) return;
    shown = key;
    const eye = p[2], path = ["Cameras", "default", "rotated", "<object>"];
    viewer.set_property(path, "zoom", run.zoom[p[1]]);
    viewer.set_property(path, "position", [eye[0], eye[2], -eye[1]]);
    viewer.set_camera_target([p[3][0], p[3][2], -p[3][1]]);
    viewer.set_dirty();
  }

  function keys(t) {
    const found = newest(run.legends, t), scan = newest(run.scans, t);
    const list = found ? found[1] : [];
    const calibrating = list.length > 0 && list[0].style === "area" && scan !== null;
    const now = JSON.stringify([list, calibrating]);
    if (now === keysOf) return;
    keysOf = now;
    el("w-keys").replaceChildren(...list.map(k => {
      const row = document.createElement("div"), i = document.createElement("i");
      i.className = k.style;
      if (k.style === "area") i.style.background = k.colour; else i.style.borderTopColor = k.colour;
      row.append(i, k.text);
      return row;
    }));
    if (calibrating) {
      const row = document.createElement("div");
      row.className = "scale";
      row.innerHTML = `Flange face beside the calibration, mm<i></i><span class="ends"><span>-${run.scale_mm}</span><span>0</span><span>+${run.scale_mm}</span></span>`;
      el("w-keys").append(row);
    }
  }

  function tell() {
    const t = viewer.animator.time;
    if (t === at && shown) return;
    at = t;
    const phase = newest(run.phases, t), weld = newest(run.weld, t), scan = newest(run.scans, t);
    say("w-phase", phase ? phase[1] : run.title);
    let text = "";
    if (weld && t - weld[0] < 1.0) {
      text = `${Math.max(weld[1], 0).toFixed(0)} mm of seam`;
      if (weld[4] !== null) text += `, deflection ${weld[4].toFixed(2)} mm`;
      if (weld[5] !== null) text += `, torch ${weld[5].toFixed(1)} mm/s`;
    } else if (scan && scan[2] !== null && !(weld && weld[0] < t)) {
      text = `${scan[1]} scans, ${scan[2].toFixed(2)} mm expected at the work point`;
      if (run.required_mm !== null) text += ` (required ${run.required_mm.toFixed(2)})`;
    }
    say("w-figures", text);
    keys(t);
    place(t);
  }
  setInterval(tell, 100);
  tell();
}
