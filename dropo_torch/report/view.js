"use strict";
(() => {
  const page = JSON.parse(document.getElementById("view-data").textContent);
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const times = floats(page.times), centers = floats(page.centers);
  const robots = page.robots.map((robot) => ({ ...robot, poses: floats(robot.poses), shown: true }));
  const takes = page.takes.map((take) => ({ ...take, residuals: floats(take.residuals) }));
  const { frames, bodies, labels, shapes, lines, camera, starts, worst } = page;
  const POSE = 7;

  // --- time ---
  const nearest = (time) => {
    let low = 0, high = frames - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] < time) low = middle + 1; else high = middle;
    }
    return low > 0 && time - times[low - 1] < times[low] - time ? low - 1 : low;
  };
  const windowOf = times.map((time) => Math.max(0, starts.findLastIndex((start) => start < time - 1e-6)));

  // --- the scene: shapes are hulls of points, drawn with a round pen ---
  const direction = { azimuth: camera.azimuth, elevation: camera.elevation };
  const axes = () => {
    const a = (direction.azimuth * Math.PI) / 180, e = (direction.elevation * Math.PI) / 180;
    const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
    return { right: [sa, -ca, 0], up: [-se * ca, -se * sa, ce], forward: [ce * ca, ce * sa, se] };
  };
  const dot = (a, x, y, z) => a[0] * x + a[1] * y + a[2] * z;
  const projector = (canvas, frame) => {
    const { right, up, forward } = axes();
    const [cx, cy, cz] = centers.subarray(3 * frame, 3 * frame + 3);
    const scale = Math.min(canvas.width / camera.width, canvas.height / camera.height);
    const project = (x, y, z) => {
      x -= cx; y -= cy; z -= cz;
      return [canvas.width / 2 + scale * dot(right, x, y, z), canvas.height / 2 - scale * dot(up, x, y, z), dot(forward, x, y, z)];
    };
    return { project, scale };
  };
  const placed = (shape, poses, frame) => {
    const found = [], p = shape.points;
    if (shape.body < 0) {
      for (let i = 0; i < p.length; i += 3) found.push([p[i], p[i + 1], p[i + 2]]);
      return found;
    }
    const at = POSE * (frame * bodies + shape.body);
    const [px, py, pz, w, x, y, z] = poses.subarray(at, at + POSE);
    for (let i = 0; i < p.length; i += 3) {
      const [a, b, c] = [p[i], p[i + 1], p[i + 2]];
      const [tx, ty, tz] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
      found.push([px + a + w * tx + y * tz - z * ty, py + b + w * ty + z * tx - x * tz, pz + c + w * tz + x * ty - y * tx]);
    }
    return found;
  };
  const hull = (points) => {
    if (points.length < 4) return points;
    const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    const turn = (o, a, b) => (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
    const half = (list) => {
      const out = [];
      for (const point of list) {
        while (out.length > 1 && turn(out[out.length - 2], out[out.length - 1], point) <= 0) out.pop();
        out.push(point);
      }
      return out.slice(0, -1);
    };
    return [...half(sorted), ...half(sorted.reverse())];
  };
  const paint = (context, points, radius, fill, edge) => {
    const path = new Path2D(), corners = hull(points);
    corners.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
    if (corners.length === 1) path.lineTo(corners[0][0] + 0.01, corners[0][1]);
    else path.closePath();
    context.lineJoin = context.lineCap = "round";
    context.strokeStyle = edge;
    context.lineWidth = 2 * radius + 2 * devicePixelRatio;
    context.stroke(path);
    context.fillStyle = context.strokeStyle = fill;
    if (radius > 0) { context.lineWidth = 2 * radius; context.stroke(path); }
    context.fill(path);
  };
  const layer = document.createElement("canvas");
  const drawShapes = (context, chosen, poses, frame, view, fill, edge) => {
    const flat = chosen.map((shape) => {
      const points = placed(shape, poses, frame).map(([x, y, z]) => view.project(x, y, z));
      return { points, radius: shape.radius * view.scale, depth: points.reduce((sum, p) => sum + p[2], 0) / points.length };
    });
    flat.sort((a, b) => b.depth - a.depth);
    for (const { points, radius } of flat) if (points.every((p) => isFinite(p[0]))) paint(context, points, radius, fill, edge);
  };
  const draw = (canvas, frame) => {
    const context = canvas.getContext("2d"), view = projector(canvas, frame);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.strokeStyle = "#dfe4e9";
    context.lineWidth = devicePixelRatio;
    context.beginPath();
    for (const line of lines)
      for (let i = 0; i < line.length; i += 3) {
        const [x, y] = view.project(line[i], line[i + 1], line[i + 2]);
        if (i) context.lineTo(x, y); else context.moveTo(x, y);
      }
    context.stroke();
    drawShapes(context, shapes.filter((s) => s.body < 0), null, frame, view, "#eef1f4", "#b4bec8");
    const moving = shapes.filter((s) => s.body >= 0);
    layer.width = canvas.width;
    layer.height = canvas.height;
    for (const robot of robots.filter((r) => r.shown)) {
      const own = layer.getContext("2d");
      own.clearRect(0, 0, layer.width, layer.height);
      drawShapes(own, moving, robot.poses, frame, view, robot.fill, robot.edge);
      context.globalAlpha = robot.alpha;
      context.drawImage(layer, 0, 0);
      context.globalAlpha = 1;
    }
  };
  const sized = (canvas) => {
    const width = canvas.clientWidth || 300;
    canvas.width = Math.round(width * devicePixelRatio);
    canvas.height = Math.round((canvas.clientHeight || width / 2) * devicePixelRatio);
  };

  // --- residuals: linear within the noise, logarithmic beyond ---
  const NS = document.getElementById("view-svg").namespaceURI;
  const squeeze = (value) => Math.asinh(value / 2);
  const HEIGHT = 100, WIDTH = 1000;
  const first = times[0], span = Math.max(times[frames - 1] - first, 1e-9);
  const across = (time) => (WIDTH * (time - first)) / span;
  const node = (name, attributes, parent) => {
    const made = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
    return made;
  };
  const cursors = [], readings = [];
  const shortened = (value) => {
    if (!isFinite(value)) return "diverged";
    const size = Math.abs(value);
    const text = size < 0.05 ? "0" : size < 100 ? value.toFixed(1) : size < 1e5 ? value.toFixed(0) : value.toExponential(0).replace("+", "");
    return text.replace("-", "−");
  };
  const strip = (figure, column) => {
    const count = labels.length;
    let top = 3;
    for (const take of takes)
      for (let f = 0; f < frames; f++) {
        const value = Math.abs(take.residuals[f * count + column]);
        if (isFinite(value) && value > top) top = value;
      }
    const height = (value) => HEIGHT / 2 - (0.48 * HEIGHT * squeeze(value)) / squeeze(top);
    const plot = figure.querySelector(".strip");
    const svg = node("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": `residuals of ${labels[column]}` }, plot);
    node("rect", { x: 0, width: WIDTH, y: height(2), height: height(-2) - height(2), class: "band" }, svg);
    for (const start of starts) node("line", { x1: across(start), x2: across(start), y1: 0, y2: HEIGHT, class: "window" }, svg);
    node("line", { x1: 0, x2: WIDTH, y1: HEIGHT / 2, y2: HEIGHT / 2, class: "zero" }, svg);
    const mark = [1e6, 1e5, 1e4, 1e3, 100, 10, 2].find((value) => value <= top) ?? 2;
    for (const value of [mark, -mark]) {
      const tick = document.createElement("span");
      tick.textContent = shortened(value).replace(/\.0$/, "");
      tick.style.top = `${(100 * height(value)) / HEIGHT}%`;
      plot.append(tick);
    }
    for (const take of takes) {
      let path = "", last = -1;
      for (let f = 0; f < frames; f++) {
        const value = take.residuals[f * count + column], x = across(times[f]).toFixed(1);
        if (!isFinite(value)) { last = -1; continue; }
        if (windowOf[f] !== last) path += `M${across(starts[windowOf[f]]).toFixed(1)} ${HEIGHT / 2}`;
        path += `L${x} ${height(value).toFixed(2)}`;
        last = windowOf[f];
      }
      node("path", { d: path, stroke: take.color }, svg);
    }
    cursors.push(node("line", { y1: 0, y2: HEIGHT, class: "cursor" }, svg));
    readings.push([...figure.querySelectorAll("output")]);
    const seek = (event) => {
      const box = plot.getBoundingClientRect();
      show(nearest(first + (span * (event.clientX - box.left)) / box.width));
    };
    plot.addEventListener("pointerdown", (event) => { pause(); seek(event); });
    plot.addEventListener("pointermove", (event) => { if (event.buttons) seek(event); });
  };

  // --- the player ---
  const scene = document.getElementById("scene"), slider = document.getElementById("slider");
  const button = document.getElementById("play"), clock = document.getElementById("clock"), speed = document.getElementById("speed");
  let current = 0, playing = null;
  const show = (frame) => {
    current = Math.min(Math.max(frame, 0), frames - 1);
    if (scene) draw(scene, current);
    slider.value = current;
    slider.setAttribute("aria-valuetext", `${times[current].toFixed(2)} s`);
    clock.textContent = `${times[current].toFixed(2)} s`;
    cursors.forEach((cursor) => { for (const end of ["x1", "x2"]) cursor.setAttribute(end, across(times[current])); });
    readings.forEach((outputs, column) => outputs.forEach((output, t) => { output.textContent = shortened(takes[t].residuals[current * labels.length + column]); }));
  };
  const pause = () => {
    if (playing) cancelAnimationFrame(playing);
    playing = null;
    button.textContent = "▶";
    button.setAttribute("aria-label", "play");
  };
  const play = () => {
    if (current === frames - 1) show(0);
    const began = performance.now(), from = times[current];
    const tick = (now) => {
      const time = from + (Number(speed.value) * (now - began)) / 1000;
      show(nearest(time));
      if (time >= times[frames - 1]) pause(); else playing = requestAnimationFrame(tick);
    };
    button.textContent = "❚❚";
    button.setAttribute("aria-label", "pause");
    playing = requestAnimationFrame(tick);
  };
  const step = (by) => { pause(); show(current + by); };
  const windowStep = (by) => {
    const next = starts.map(nearest).filter((frame) => (by > 0 ? frame > current : frame < current));
    step((next.length ? (by > 0 ? Math.min(...next) : Math.max(...next)) : by > 0 ? frames - 1 : 0) - current);
  };
  button.addEventListener("click", () => (playing ? pause() : play()));
  speed.addEventListener("change", () => { if (playing) { pause(); play(); } });
  slider.addEventListener("input", () => { pause(); show(Number(slider.value)); });
  document.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    const size = event.shiftKey ? 10 : 1;
    const keys = {
      ArrowRight: () => step(size), ArrowLeft: () => step(-size), Home: () => step(-frames), End: () => step(frames),
      PageDown: () => windowStep(1), PageUp: () => windowStep(-1),
      " ": () => { if (event.target.tagName !== "BUTTON" && event.target.type !== "checkbox") button.click(); else return true; },
    };
    if (keys[event.key] && !keys[event.key]()) event.preventDefault();
  });
  document.querySelectorAll("[data-robot]").forEach((box) => box.addEventListener("change", () => {
    robots[Number(box.dataset.robot)].shown = box.checked;
    redraw();
  }));
  document.querySelectorAll("[data-frame]").forEach((link) => link.addEventListener("click", () => { pause(); show(Number(link.dataset.frame)); }));
  if (scene) {
    let held = null;
    scene.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; scene.setPointerCapture(event.pointerId); });
    scene.addEventListener("pointermove", (event) => {
      if (!held) return;
      direction.azimuth -= 0.4 * (event.clientX - held[0]);
      direction.elevation = Math.min(Math.max(direction.elevation - 0.4 * (event.clientY - held[1]), -90), 90);
      held = [event.clientX, event.clientY];
      show(current);
    });
    for (const end of ["pointerup", "pointercancel"]) scene.addEventListener(end, () => { held = null; redraw(); });
    scene.addEventListener("dblclick", () => { Object.assign(direction, { azimuth: camera.azimuth, elevation: camera.elevation }); redraw(); });
  }
  const stills = [...document.querySelectorAll("canvas[data-frame]")];
  const redraw = () => {
    for (const still of stills) { sized(still); draw(still, Number(still.dataset.frame)); }
    if (scene) sized(scene);
    show(current);
  };
  document.querySelectorAll("figure[data-column]").forEach((figure) => strip(figure, Number(figure.dataset.column)));
  addEventListener("resize", redraw);
  addEventListener("beforeprint", redraw);
  current = worst;
  redraw();
})();
