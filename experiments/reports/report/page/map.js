// The map view: a canvas, since thousands of landmarks with ellipses change at every step.

(() => {
  if (!DATA.map) return;
  const MAP = DATA.map;
  const canvas = byId("plan");
  const pen = canvas.getContext("2d");
  const slider = byId("iteration");
  const bytes = Uint8Array.from(atob(MAP.block), (character) => character.charCodeAt(0));
  const N_MARGIN = 0.06; // of the view
  const FRAMES_PER_S = 8;
  const KINDS = { i2: Int16Array, u2: Uint16Array, u4: Uint32Array, u1: Uint8Array };
  const LAYERS = [
    ["walls", "walls (truth)", true],
    ["mapA", "", true],
    ["mapB", "", true],
    ["ellipses", `${MAP.level} ellipses`, true],
    ["true", "true correspondences", true],
    ["false", "false correspondences", true],
    ["particles", "particles", true],
    ["paths", "paths, estimated", true],
    ["truePaths", "paths, true", true],
    ["fused", `fused (${MAP.merge_aligner})`, true],
  ];
  const shown = Object.fromEntries(LAYERS.map(([name, , on]) => [name, on]));
  const counts = {};
  let pair = MAP.pairs[0];
  let placed = "";
  let stage = "refined";
  let view = null; // {x, y, scale}: world point in the middle, pixels a metre
  let drawing_ = 0;
  let timer = null;

  function array(at, kind) {
    return new KINDS[kind](bytes.buffer, at[0], at[1]);
  }

  // Rigid motions of the plane, [x, y, theta], as in the library.
  function compose(a, b) {
    const c = Math.cos(a[2]), s = Math.sin(a[2]);
    return [a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]];
  }

  const known = (motion) => motion && motion.every((value) => value !== null);

  /** What is drawn at this moment: motions into the world, and the alignment behind them. */
  function situation() {
    const frame = pair.frames[Number(slider.value)];
    const alignment = placed === "" ? null : (pair.alignments[placed] || [])[Number(slider.value)];
    const motion = placed === "" ? pair.truth : alignment && alignment[stage];
    return {
      frame,
      alignment,
      T_world: [pair.start, known(motion) ? compose(pair.start, motion) : null],
    };
  }

  /** Points of a robot's map in the world, (2 n) metres. */
  function points(at, step_m, T) {
    const steps = array(at, "i2");
    const out = new Float32Array(steps.length);
    const c = Math.cos(T[2]) * step_m, s = Math.sin(T[2]) * step_m;
    for (let i = 0; i < steps.length; i += 2) {
      out[i] = T[0] + c * steps[i] - s * steps[i + 1];
      out[i + 1] = T[1] + s * steps[i] + c * steps[i + 1];
    }
    return out;
  }

  function draw() {
    drawing_ = 0;
    const ratio = devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    if (!view) view = fitted(width, height);
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    // metres, y upwards
    const k = ratio * view.scale;
    pen.setTransform(k, 0, 0, -k, ratio * width / 2 - k * view.x, ratio * height / 2 + k * view.y);
    const now = situation();
    const px = 1 / view.scale;
    const maps = pair.robots.map((robot, i) => mapOf(robot, now.frame.map, now.T_world[i]));
    if (shown.walls) drawWalls(px);
    drawPaths(now, px);
    pair.robots.forEach((robot, i) => {
      if (shown[i ? "mapB" : "mapA"] && maps[i]) drawMap(maps[i], MAP_COLOURS(robot), now.T_world[i], px);
    });
    drawPairs(now, maps, px);
    if (shown.fused) drawFused(now, px);
    drawRobots(now, px);
    drawScale(ratio, width, height);
    tellFacts(now, maps);
  }

  const MAP_COLOURS = (robot) => DATA.robot_colours[robot];

  function mapOf(robot, place, T) {
    const own = MAP.robots[robot].maps[place];
    return T && { at: points(own.at, MAP.robots[robot].step_m, T), ellipses: array(own.ellipses, "u1") };
  }

  function drawWalls(px) {
    pen.lineWidth = 1.2 * px;
    pen.lineCap = pen.lineJoin = "round";
    pen.strokeStyle = colour("wall");
    pen.beginPath();
    for (const wall of MAP.walls) wall.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.stroke();
  }

  function drawPaths(now, px) {
    const until = now.frame.iteration + 1;
    pair.robots.forEach((robot, i) => {
      const own = MAP.robots[robot];
      const start = MAP.starts[robot] || null;
      for (const [layer, name, T] of [["truePaths", "truth", start], ["paths", "online", now.T_world[i]]]) {
        if (!shown[layer] || !T || !own.paths[name]) continue;
        const line = points(own.paths[name], own.step_m, T);
        pen.beginPath();
        for (let j = 0; j < Math.min(2 * until, line.length); j += 2) pen.lineTo(line[j], line[j + 1]);
        pen.lineWidth = (name === "truth" ? 1.2 : 2) * px;
        pen.setLineDash(name === "truth" ? [5 * px, 4 * px] : []);
        pen.strokeStyle = name === "truth" ? colour("muted") : colour(MAP_COLOURS(robot));
        pen.stroke();
        pen.setLineDash([]);
      }
    });
  }

  function drawMap(map, name, T, px) {
    const size = 1.5 * px;
    pen.fillStyle = faint(name, 0.85);
    pen.beginPath();
    for (let i = 0; i < map.at.length; i += 2) pen.rect(map.at[i] - size, map.at[i + 1] - size, 2 * size, 2 * size);
    pen.fill();
    if (shown.ellipses) drawEllipses(map, faint(name, 0.22), 0.8 * px, T[2]);
  }

  const AXES = Array.from({ length: 256 }, (_, i) => {
    const [least, most] = MAP.ellipse_m;
    return least * (most / least) ** (i / 255);
  });

  function drawEllipses({ at, ellipses }, style, lineWidth, turn) {
    pen.strokeStyle = style;
    pen.lineWidth = lineWidth;
    pen.beginPath();
    for (let i = 0, j = 0; i < at.length; i += 2, j += 3) {
      const major = AXES[ellipses[j]], angle = (ellipses[j + 2] / 256) * Math.PI + turn;
      pen.moveTo(at[i] + major * Math.cos(angle), at[i + 1] + major * Math.sin(angle));
      pen.ellipse(at[i], at[i + 1], major, AXES[ellipses[j + 1]], angle, 0, 2 * Math.PI);
    }
    pen.stroke();
  }

  function drawPairs(now, maps, px) {
    const { frame } = now;
    counts.true = counts.false = null;
    if (!frame.pairs) return;
    const rows = array(frame.pairs, MAP.index_bytes === 2 ? "u2" : "u4");
    const right = array(frame.true, "u1");
    counts.true = frame.n_true;
    counts.false = right.length - frame.n_true;
    if (!maps[0] || !maps[1]) return;
    for (const [layer, wanted, style, width, dash] of [
      ["false", 0, faint("muted", 0.32), 0.8, [4, 3]],
      ["true", 1, faint("ink", 0.75), 1.1, []],
    ]) {
      if (!shown[layer]) continue;
      pen.strokeStyle = style;
      pen.lineWidth = width * px;
      pen.setLineDash(dash.map((length) => length * px));
      pen.beginPath();
      for (let i = 0; i < right.length; i++) {
        if (right[i] !== wanted) continue;
        const a = 2 * rows[2 * i], b = 2 * rows[2 * i + 1];
        pen.moveTo(maps[0].at[a], maps[0].at[a + 1]);
        pen.lineTo(maps[1].at[b], maps[1].at[b + 1]);
      }
      pen.stroke();
      pen.setLineDash([]);
    }
  }

  function drawFused(now, px) {
    const { fused } = now.frame;
    counts.fused = fused ? fused.at[1] / 2 : 0;
    if (!fused) return;
    const at = points(fused.at, MAP.robots[pair.robots[0]].step_m, pair.start);
    const size = 2.2 * px;
    pen.strokeStyle = faint("ink", 0.7);
    pen.lineWidth = 0.8 * px;
    pen.beginPath();
    for (let i = 0; i < at.length; i += 2) pen.rect(at[i] - size, at[i + 1] - size, 2 * size, 2 * size);
    pen.stroke();
    if (shown.ellipses) drawEllipses({ at, ellipses: array(fused.ellipses, "u1") }, faint("ink", 0.25), 0.8 * px, pair.start[2]);
  }

  function drawRobots(now, px) {
    counts.particles = null;
    pair.robots.forEach((robot, i) => {
      const own = MAP.robots[robot], T = now.T_world[i];
      if (!T || !own.paths.online) return;
      const line = points(own.paths.online, own.step_m, T);
      const last = Math.min(now.frame.iteration, line.length / 2 - 1);
      const theta = own.paths.theta_rad[last] + T[2];
      drawRobot(line[2 * last], line[2 * last + 1], theta, MAP_COLOURS(robot), px);
      const cloud = own.clouds[now.frame.map];
      if (shown.particles && cloud) {
        const at = points(cloud.at, own.step_m, T);
        counts.particles = at.length / 2;
        pen.fillStyle = faint("warm", 0.7);
        const size = 1.3 * px;
        for (let j = 0; j < at.length; j += 2) pen.fillRect(at[j] - size, at[j + 1] - size, 2 * size, 2 * size);
      }
    });
  }

  function drawRobot(x, y, theta, name, px) {
    const length = Math.max(0.25, 9 * px);
    pen.save();
    pen.translate(x, y);
    pen.rotate(theta);
    pen.beginPath();
    pen.moveTo(length, 0);
    pen.lineTo(-0.7 * length, 0.65 * length);
    pen.lineTo(-0.35 * length, 0);
    pen.lineTo(-0.7 * length, -0.65 * length);
    pen.closePath();
    pen.fillStyle = colour(name);
    pen.fill();
    pen.lineWidth = 1.5 * px;
    pen.strokeStyle = colour("sheet");
    pen.stroke();
    pen.restore();
  }

  /** A scale bar in the corner, of a round length. */
  function drawScale(ratio, width, height) {
    const wanted = 110 / view.scale;
    const power = 10 ** Math.floor(Math.log10(wanted));
    const length = [5, 2, 1].find((step) => step * power <= wanted) * power;
    const px = length * view.scale;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour("muted");
    pen.fillRect(width - 14 - px, height - 16, px, 2);
    pen.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    pen.textAlign = "right";
    pen.fillText(`${length < 1 ? Number(length.toPrecision(1)) : length} m`, width - 14, height - 22);
  }

  function tellFacts(now, maps) {
    byId("k").textContent = now.frame.iteration;
    const facts = [];
    const { alignment } = now;
    const n = now.frame.true ? now.frame.true[1] : 0;
    facts.push(["true pairs", MAP.no_truth ? "no truth" : `${counts.true ?? 0} of ${n}`]);
    if (placed !== "") {
      const error = alignment && alignment.error[stage];
      facts.push(["error", error && error[0] !== null ? `${short(error[0])} m, ${short(error[1])} rad` : MAP.no_truth ? "no truth" : "no estimate"]);
      facts.push(["status", alignment ? (alignment.accepted ? "accepted" : alignment.status === "accepted" ? "refused" : alignment.status) : "–"]);
      if (alignment && alignment.reason) facts.push(["reason", alignment.reason]);
    }
    const list = byId("plan-facts");
    list.replaceChildren(...facts.map(([term, value]) => {
      const row = element("div");
      row.append(element("dt", {}, term), element("dd", {}, value));
      return row;
    }));
    byId("plan-hint").textContent = now.T_world[1] ? "" : `${pair.robots[1]} is not drawn: no estimate`;
    counts.mapA = maps[0] ? maps[0].at.length / 2 : null;
    counts.mapB = maps[1] ? maps[1].at.length / 2 : null;
    for (const output of document.querySelectorAll("#layers .count")) output.textContent = counts[output.dataset.layer] ?? "";
  }

  // The view

  /** All walls, and both maps where the truth puts them. */
  function fitted(width, height) {
    const xs = [], ys = [];
    for (const wall of MAP.walls) for (const [x, y] of wall) { xs.push(x); ys.push(y); }
    if (!xs.length) {
      const now = situation();
      pair.robots.forEach((robot, i) => {
        const map = mapOf(robot, pair.frames[pair.frames.length - 1].map, now.T_world[i]);
        if (map) map.at.forEach((value, j) => (j % 2 ? ys : xs).push(value));
      });
    }
    const [left, right] = middle(xs), [low, high] = middle(ys);
    const span = (a, b) => Math.max(b - a, 1) * (1 + 2 * N_MARGIN);
    const scale = Math.min(width / span(left, right), height / span(low, high));
    return { x: (left + right) / 2, y: (low + high) / 2, scale };
  }

  /** The range of the values but for a few strays. */
  function middle(values) {
    if (!values.length) return [-1, 1];
    const sorted = Float64Array.from(values).sort();
    const cut = values.length > 400 ? Math.floor(0.005 * values.length) : 0;
    return [sorted[cut], sorted[sorted.length - 1 - cut]];
  }

  function wish() {
    if (!drawing_) drawing_ = requestAnimationFrame(draw);
  }

  function zoom(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
    const dx = (x - canvas.clientWidth / 2) / view.scale, dy = (canvas.clientHeight / 2 - y) / view.scale;
    const scale = Math.min(2000, Math.max(2, view.scale * factor));
    const left = 1 - view.scale / scale;
    view = { x: view.x + dx * left, y: view.y + dy * left, scale };
    wish();
  }

  byId("zoom-in").addEventListener("click", () => zoom(1.5));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
  byId("zoom-fit").addEventListener("click", () => { view = null; wish(); });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 300), event.offsetX, event.offsetY);
  }, { passive: false });

  const pointers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
    canvas.classList.add("dragging");
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      pointers.delete(event.pointerId);
      canvas.classList.remove("dragging");
    });
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    if (pointers.size === 1) {
      view = { ...view, x: view.x - (event.offsetX - before.offsetX) / view.scale, y: view.y + (event.offsetY - before.offsetY) / view.scale };
      wish();
    } else {
      const other = [...pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
      const apart = (a, b) => Math.hypot(a.offsetX - b.offsetX, a.offsetY - b.offsetY) || 1;
      zoom(apart(event, other) / apart(before, other), (event.offsetX + other.offsetX) / 2, (event.offsetY + other.offsetY) / 2);
    }
    pointers.set(event.pointerId, event);
  });

  // Controls

  function layerIcon(name) {
    const svg = drawing("svg", { viewBox: "0 0 26 14", "aria-hidden": "true" });
    const robot = (i) => `var(--${MAP_COLOURS(pair.robots[i])})`;
    const stroke = (style, width, dash = "none") => drawing("line", { x1: 1, y1: 7, x2: 25, y2: 7, stroke: style, "stroke-width": width, "stroke-dasharray": dash });
    const dots = (style) => [4, 11, 15, 22].map((x, i) => drawing("rect", { x, y: [3, 8, 2, 7][i], width: 3, height: 3, fill: style }));
    const parts = {
      walls: () => [stroke("var(--wall)", 4)],
      mapA: () => dots(robot(0)),
      mapB: () => dots(robot(1)),
      ellipses: () => [drawing("ellipse", { cx: 13, cy: 7, rx: 11, ry: 4, fill: "none", stroke: "var(--muted)" })],
      true: () => [stroke("var(--ink)", 1.6)],
      false: () => [stroke("var(--muted)", 1.2, "4 3")],
      particles: () => dots("var(--warm)"),
      paths: () => [stroke(robot(0), 2.2)],
      truePaths: () => [stroke("var(--muted)", 1.6, "5 3")],
      fused: () => [drawing("rect", { x: 9, y: 3, width: 8, height: 8, fill: "none", stroke: "var(--ink)", "stroke-width": 1.4 })],
    };
    svg.append(...parts[name]());
    return svg;
  }

  function fillLayers() {
    const rows = LAYERS.map(([name, text]) => {
      const label = element("label", { class: "layer" });
      const box = element("input", { type: "checkbox", id: `layer-${name}` });
      box.checked = shown[name];
      box.addEventListener("change", () => { shown[name] = box.checked; wish(); });
      const named = { mapA: `map of ${pair.robots[0]}`, mapB: `map of ${pair.robots[1]}` }[name] || text;
      const count = element("span", { class: "count" });
      count.dataset.layer = name;
      label.append(box, layerIcon(name), element("span", {}, named), count);
      return label;
    });
    byId("layers").replaceChildren(element("legend", {}, "Layers"), ...rows);
  }

  /** The slider's track is shaded where the maps share too little, as the charts are. */
  function shadeTrack() {
    const n = pair.frames.length;
    const edges = pair.frames.map((frame, i) => {
      const style = (frame.n_true || 0) < DATA.min_true_pairs ? "var(--shade)" : "var(--track)";
      return `${style} ${(100 * i) / n}% ${(100 * (i + 1)) / n}%`;
    });
    byId("track").style.background = `linear-gradient(to right, ${edges.join(", ")})`;
  }

  function choosePair(place) {
    const iteration = pair.frames.length ? pair.frames[Math.min(Number(slider.value), pair.frames.length - 1)].iteration : 0;
    pair = MAP.pairs[place];
    slider.max = pair.frames.length - 1;
    goTo(iteration);
    view = null;
    fillLayers();
    shadeTrack();
  }

  /** The evaluated iteration nearest to the one asked for. */
  function goTo(iteration) {
    let best = 0;
    pair.frames.forEach((frame, i) => {
      if (Math.abs(frame.iteration - iteration) < Math.abs(pair.frames[best].iteration - iteration)) best = i;
    });
    slider.value = best;
    wish();
  }

  function moved() {
    slider.setAttribute("aria-valuetext", `iteration ${pair.frames[Number(slider.value)].iteration}`);
    tell("iteration", { iteration: pair.frames[Number(slider.value)].iteration, from: "map" });
    wish();
  }

  function play(on) {
    clearInterval(timer);
    timer = on ? setInterval(() => {
      if (Number(slider.value) === Number(slider.max)) { play(false); return; }
      slider.value = Number(slider.value) + 1;
      moved();
    }, 1000 / FRAMES_PER_S) : null;
    byId("play").textContent = on ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", on ? "Pause" : "Play");
  }

  byId("play").addEventListener("click", () => {
    if (!timer && Number(slider.value) === Number(slider.max)) slider.value = 0;
    play(!timer);
  });
  slider.addEventListener("input", moved);
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    slider.value = Number(slider.value) + step;
    moved();
  });

  fillSelect(byId("pair"), MAP.pairs.map(({ robots }) => robots.join(" – ")));
  byId("pair").addEventListener("change", (event) => choosePair(Number(event.target.value)));
  const placers = Object.keys(pair.alignments);
  for (const name of placers) byId("placed").append(element("option", { value: name }, name));
  if (pair.truth) byId("placed").append(element("option", { value: "" }, "the truth"));
  placed = placers.includes(MAP.merge_aligner) ? MAP.merge_aligner : placers[0] || "";
  byId("placed").value = placed;
  byId("placed").addEventListener("change", (event) => { placed = event.target.value; wish(); });
  segments({ estimated: byId("place-estimated"), refined: byId("place-refined") }, (name) => { stage = name; wish(); });
  BUS.addEventListener("iteration", (event) => { if (event.detail.from === "chart") { goTo(event.detail.iteration); } });
  BUS.addEventListener("group", ({ detail }) => {
    if (detail.group >= MAP.pairs.length) return; // all pairs together
    byId("pair").value = detail.group;
    choosePair(detail.group);
  });
  BUS.addEventListener("theme", wish);
  new ResizeObserver(() => { view = null; wish(); }).observe(canvas);
  addEventListener("beforeprint", draw);

  slider.max = pair.frames.length - 1;
  slider.value = slider.max;
  fillLayers();
  shadeTrack();
  wish();
})();
