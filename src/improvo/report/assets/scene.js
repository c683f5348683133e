// The 3D map: points and trajectory on a 2D canvas, turned with mouse, fingers or arrow keys. No library, no network.
"use strict";
(() => {
  const canvas = document.getElementById("scene");
  if (!canvas) return;
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  const layers = Object.fromEntries(Object.entries(data.layers).map(([name, layer]) =>
    [name, { xyz: floats(layer.xyz), rgb: bytes(layer.rgb) }]));
  const poses = floats(data.poses); // 12 a pose: centre, then the camera's x, y and z axes
  const count = poses.length / 12;
  const truth = data.truth ? floats(data.truth) : null; // 3 a pose, NaN without one
  const context = canvas.getContext("2d");
  const start = { yaw: -0.5, pitch: 0.85, distance: 1.6 * data.radius, centre: [...data.centre] };
  const view = { ...start, centre: [...start.centre] };
  let layer = Object.keys(layers)[0];
  let current = count - 1;
  let pending = false;

  function projector(width, height) {
    const [sy, cy, sp, cp] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
    const [cx, cY, cz] = view.centre;
    const focal = 1.1 * Math.min(width, height);
    return (x, y, z, out) => {
      const a = x - cx, b = y - cY, c = z - cz;
      const right = cy * a + sy * b, ahead = -sy * a + cy * b;
      const depth = view.distance + cp * ahead - sp * c;
      const up = sp * ahead + cp * c;
      out[0] = width / 2 + (focal * right) / depth;
      out[1] = height / 2 - (focal * up) / depth;
      out[2] = depth;
    };
  }

  function drawPoints(width, height, project) {
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    pixels.fill(0xff352f2b);
    const { xyz, rgb } = layers[layer];
    const out = [0, 0, 0];
    const size = Math.max(1, Math.round(Math.min(width, height) / 280));
    for (let i = 0; i < xyz.length / 3; i++) {
      project(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2], out);
      const x = out[0] | 0, y = out[1] | 0;
      if (out[2] < 0.02 * data.radius || x < 0 || y < 0 || x >= width - size || y >= height - size) continue;
      const colour = 0xff000000 | (rgb[3 * i + 2] << 16) | (rgb[3 * i + 1] << 8) | rgb[3 * i];
      for (let v = 0; v < size; v++) for (let u = 0; u < size; u++) pixels[(y + v) * width + x + u] = colour;
    }
    context.putImageData(image, 0, 0);
  }

  function line(project, from, to, colour, thickness) {
    const a = [0, 0, 0], b = [0, 0, 0];
    project(...from, a);
    project(...to, b);
    if (Math.min(a[2], b[2]) < 0.02 * data.radius) return;
    context.strokeStyle = colour;
    context.lineWidth = thickness;
    context.beginPath();
    context.moveTo(a[0], a[1]);
    context.lineTo(b[0], b[1]);
    context.stroke();
  }

  const centreOf = (i) => [poses[12 * i], poses[12 * i + 1], poses[12 * i + 2]];
  const ramp = (share) => {
    const k = 3 * Math.round(share * (data.ramp.length / 3 - 1));
    return `rgb(${data.ramp[k]},${data.ramp[k + 1]},${data.ramp[k + 2]})`;
  };

  function drawPath(project, scale) {
    context.lineCap = "round";
    const lastOnes = count - 1 - data.last;
    for (const [wide, colourOf] of [[9, (i) => (data.doubted[i] ? "#ff4fd8" : null)], [5, (i) => (i > lastOnes ? "#fff" : null)], [3, (i) =>
      (i > lastOnes ? "#000" : ramp(data.frame_indices[i] / Math.max(1, data.frames - 1)))]]) {
      for (let i = 1; i < count; i++) {
        const colour = colourOf(i);
        if (colour && data.segments[i] === data.segments[i - 1])
          line(project, centreOf(i - 1), centreOf(i), colour, wide * scale);
      }
    }
  }

  function drawTruth(project, scale) {
    for (let i = 1; truth && i < count; i++) {
      const [from, to] = [i - 1, i].map((k) => [truth[3 * k], truth[3 * k + 1], truth[3 * k + 2]]);
      if (data.segments[i] === data.segments[i - 1] && !Number.isNaN(from[0] + to[0]))
        line(project, from, to, "#7fffd4", 1.3 * scale);
    }
  }

  function drawCamera(project, scale) {
    const p = poses.subarray(12 * current, 12 * current + 12);
    const size = 0.07 * data.radius;
    const corner = (u, v) => [0, 1, 2].map((k) =>
      p[k] + size * (u * data.half_width * p[3 + k] + v * data.half_height * p[6 + k] + p[9 + k]));
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    const centre = [p[0], p[1], p[2]];
    corners.forEach((c, k) => {
      line(project, centre, c, "#ffd54a", 1.6 * scale);
      line(project, c, corners[(k + 1) % 4], "#ffd54a", 1.6 * scale);
    });
  }

  function draw() {
    pending = false;
    const scale = Math.min(2, window.devicePixelRatio || 1);
    const width = Math.max(2, Math.round(canvas.clientWidth * scale));
    const height = Math.max(2, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const project = projector(width, height);
    drawPoints(width, height, project);
    drawPath(project, scale);
    drawTruth(project, scale);
    if (count) drawCamera(project, scale);
    canvas.dataset.yaw = view.yaw.toFixed(3);
    canvas.dataset.distance = view.distance.toFixed(4);
    canvas.dataset.camera = count ? data.frame_indices[current] : "";
    canvas.dataset.layer = layer;
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
  }

  function redraw() {
    if (!pending) {
      pending = true;
      requestAnimationFrame(draw);
    }
  }

  function turn(dx, dy) {
    view.yaw -= 0.008 * dx;
    view.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, view.pitch + 0.008 * dy));
    redraw();
  }

  function move(dx, dy) {
    const step = view.distance / (1.1 * Math.min(canvas.clientWidth, canvas.clientHeight));
    const [sy, cy, sp, cp] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
    view.centre[0] += step * (-dx * cy - dy * sp * sy);
    view.centre[1] += step * (-dx * sy + dy * sp * cy);
    view.centre[2] += step * dy * cp;
    redraw();
  }

  function zoom(factor) {
    view.distance = Math.min(20 * data.radius, Math.max(0.03 * data.radius, view.distance * factor));
    redraw();
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const spread = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      zoom(spread(before) / spread(now));
      move((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    } else if (event.shiftKey || event.buttons & 2) move(now[0] - before[0], now[1] - before[1]);
    else turn(now[0] - before[0], now[1] - before[1]);
    fingers.set(event.pointerId, now);
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return; // the page scrolls until the map is clicked
    event.preventDefault();
    zoom(Math.exp(0.0012 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    if (steps[event.key]) turn(...steps[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(0.85);
    else if (event.key === "-") zoom(1.18);
    else return;
    event.preventDefault();
  });
  document.getElementById("scene-reset").addEventListener("click", () => {
    Object.assign(view, start, { centre: [...start.centre] });
    redraw();
  });
  document.getElementById("scene-above").addEventListener("click", () => {
    Object.assign(view, start, { centre: [...start.centre], yaw: 0, pitch: Math.PI / 2 });
    redraw();
  });
  for (const choice of document.querySelectorAll("input[name=layer]"))
    choice.addEventListener("change", () => {
      layer = choice.value;
      const legend = document.getElementById("scene-labels");
      if (legend) legend.hidden = layer !== "labels";
      redraw();
    });
  document.addEventListener("improvo-frame", (event) => {
    for (let i = 0; i < count; i++) if (data.frame_indices[i] <= event.detail) current = i;
    redraw();
  });
  window.addEventListener("resize", redraw);
  draw();
})();
