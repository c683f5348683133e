// The frame slider: a picture with its tracks, labels or residuals drawn over it.
"use strict";
(() => {
  const canvas = document.getElementById("frame");
  if (!canvas) return;
  const data = JSON.parse(document.getElementById("frame-data").textContent);
  const context = canvas.getContext("2d");
  const slider = document.getElementById("frame-slider");
  const caption = document.getElementById("frame-caption");
  const play = document.getElementById("frame-play");
  const picture = new Image();
  let overlay = "tracks";
  let timer = 0;
  const points = data.frames.map((frame) => Uint8Array.from(atob(frame.points), (c) => c.charCodeAt(0)));
  const ROW = 11; // u, v, previous u, previous v (uint16, in parts of a pixel), age, error, label (uint8)

  function colour(table, k) {
    return `rgb(${table[3 * k]},${table[3 * k + 1]},${table[3 * k + 2]})`;
  }

  function drawOverlay(bytes) {
    const rows = new DataView(bytes.buffer);
    const unit = canvas.width / data.width;
    for (let i = 0; i < bytes.length; i += ROW) {
      const [u, v, pu, pv] = [0, 2, 4, 6].map((k) => (rows.getUint16(i + k, true) / data.parts + 0.5) * unit);
      const [age, error, label] = [bytes[i + 8], bytes[i + 9], bytes[i + 10]];
      if (overlay === "residuals" && error === 255) continue;
      const shade = overlay === "labels" ? colour(data.labels, label)
        : colour(data.ramp, overlay === "tracks" ? age : error);
      context.strokeStyle = context.fillStyle = shade;
      if (overlay !== "residuals" && (overlay === "tracks" ? age > data.young : label > 0)) {
        context.lineWidth = 1.4;
        context.beginPath();
        context.moveTo(pu, pv);
        context.lineTo(u, v);
        context.stroke();
      }
      context.beginPath();
      context.arc(u, v, overlay === "labels" && label === 0 ? 1.3 : 2.2, 0, 2 * Math.PI);
      context.fill();
    }
  }

  function draw() {
    const k = Number(slider.value);
    context.filter = "brightness(0.8)";
    context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    context.filter = "none";
    if (overlay !== "none") drawOverlay(points[k]);
    caption.textContent = data.frames[k].caption;
    canvas.dataset.frame = data.frames[k].frame;
    canvas.dataset.overlay = overlay;
  }

  picture.onload = draw;
  function show() {
    const frame = data.frames[Number(slider.value)];
    picture.src = "data:image/jpeg;base64," + frame.jpeg;
    document.dispatchEvent(new CustomEvent("improvo-frame", { detail: frame.frame }));
  }
  slider.addEventListener("input", show);
  for (const choice of document.querySelectorAll("input[name=overlay]"))
    choice.addEventListener("change", () => {
      overlay = choice.value;
      for (const legend of document.querySelectorAll("[data-legend]"))
        legend.hidden = legend.dataset.legend !== overlay;
      draw();
    });
  play.addEventListener("click", () => {
    if (timer) {
      clearInterval(timer);
      timer = 0;
    } else
      timer = setInterval(() => {
        slider.value = (Number(slider.value) + 1) % data.frames.length;
        show();
      }, 120);
    play.textContent = timer ? "Pause" : "Play";
  });
  show();
})();
