"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  document.documentElement.classList.add("script");

  // Contact sheet: show the photographs of one group.
  const filters = document.getElementById("filters");
  const cards = [...document.querySelectorAll("#sheet > li")];
  filters?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    for (const other of filters.querySelectorAll("button")) {
      other.setAttribute("aria-pressed", String(other === button));
    }
    for (const card of cards) {
      card.hidden = !card.dataset.groups.split(" ").includes(button.dataset.group);
    }
    const shown = cards.filter((card) => !card.hidden).length;
    document.getElementById("shown").textContent = `${shown} of ${cards.length} photographs shown`;
  });

  // Everything that is folded is printed.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details:not([open])")];
    folded.forEach((item) => (item.open = true));
  });
  addEventListener("afterprint", () => folded.forEach((item) => (item.open = false)));

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  // Matrices: the number of the cell under the pointer.
  for (const matrix of document.querySelectorAll("[data-matrix]")) {
    const view = new DataView(bytes(data.matrices[matrix.dataset.matrix]).buffer);
    const readout = matrix.parentElement.querySelector(".readout");
    const size = data.names.length;
    const show = (event) => {
      const ground = matrix.querySelector(".ground").getBoundingClientRect();
      const column = Math.floor(((event.clientX - ground.left) / ground.width) * size);
      const row = Math.floor(((event.clientY - ground.top) / ground.height) * size);
      if (Math.min(row, column) < 0 || Math.max(row, column) >= size || row === column) {
        readout.textContent = "\u00a0";
        return;
      }
      const count = view.getUint16(2 * (row * size + column), true);
      const label = (index) => `${index + 1} ${data.names[index]}`;
      readout.textContent = `${label(row)} – ${label(column)}: ${count || "no"} inliers`;
    };
    matrix.addEventListener("pointermove", show);
    matrix.addEventListener("pointerdown", show);
  }

  // Models: all are seen from the same place, a camera pointed at is marked in all.
  const TOP = Math.PI / 2;
  const DISTANCE = 4;
  const MAX_ZOOM = 20;
  const eye = { yaw: 0, pitch: TOP, zoom: data.zoom };
  let pointedAt = "";
  let isWaiting = false;
  const limited = (value, low, high) => Math.min(Math.max(value, low), high);

  function turn(yaw, pitch) {
    eye.yaw += yaw;
    eye.pitch = limited(eye.pitch + pitch, -TOP, TOP);
    redraw();
  }

  function zoom(factor) {
    eye.zoom = limited(eye.zoom * factor, 0.3, MAX_ZOOM);
    redraw();
  }

  function redraw() {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      models.forEach((model) => model.draw());
    });
  }

  class Model {
    constructor(canvas) {
      const source = data.views[canvas.dataset.model];
      const buffer = bytes(source.points).buffer;
      this.count = source.count;
      this.places = new Uint16Array(buffer, 0, 3 * this.count);
      this.colors = new Uint8Array(buffer, 6 * this.count);
      this.cameras = source.cameras;
      this.canvas = canvas;
      this.context = canvas.getContext("2d");
      this.readout = canvas.parentElement.querySelector(".readout");
      this.pointers = new Map();
      this.listen();
      new ResizeObserver(() => redraw()).observe(canvas);
    }

    projection(width, height) {
      const [sinYaw, cosYaw] = [Math.sin(eye.yaw), Math.cos(eye.yaw)];
      const [sinPitch, cosPitch] = [Math.sin(eye.pitch), Math.cos(eye.pitch)];
      const scale = (Math.min(width, height) / 2) * eye.zoom;
      return (x, y, z) => {
        const right = cosYaw * x - sinYaw * y;
        const away = sinYaw * x + cosYaw * y;
        const depth = DISTANCE + away * cosPitch - z * sinPitch;
        const size = depth > 0.2 ? (scale * DISTANCE) / depth : NaN;
        const up = away * sinPitch + z * cosPitch;
        return [width / 2 + right * size, height / 2 - up * size, depth];
      };
    }

    draw() {
      const { canvas, context } = this;
      const density = Math.min(devicePixelRatio || 1, 2);
      const width = Math.round(canvas.clientWidth * density);
      const height = Math.round(canvas.clientHeight * density);
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) {
        canvas.width = width;
        canvas.height = height;
      }
      const project = this.projection(width, height);
      this.drawPoints(project, width, height, density);
      const style = getComputedStyle(canvas);
      context.lineJoin = "round";
      for (const camera of this.cameras) {
        const isPointedAt = camera.name === pointedAt;
        const places = [];
        for (let index = 0; index < 15; index += 3) {
          places.push(project(...camera.corners.slice(index, index + 3)));
        }
        camera.place = [places[0][0] / density, places[0][1] / density];
        context.strokeStyle = isPointedAt ? "#e2604f" : style.color;
        context.lineWidth = (isPointedAt ? 3 : 1.3) * density;
        context.beginPath();
        for (let corner = 1; corner < 5; corner++) {
          context.moveTo(places[0][0], places[0][1]);
          context.lineTo(places[corner][0], places[corner][1]);
          const next = places[(corner % 4) + 1];
          context.lineTo(next[0], next[1]);
        }
        context.stroke();
      }
    }

    drawPoints(project, width, height, density) {
      const image = this.context.createImageData(width, height);
      const pixels = new Uint32Array(image.data.buffer);
      const nearest = new Float32Array(width * height).fill(Infinity);
      const side = Math.max(1, Math.round(density * 1.5));
      for (let index = 0; index < 3 * this.count; index += 3) {
        const [x, y, depth] = project(
          this.places[index] / 32767.5 - 1,
          this.places[index + 1] / 32767.5 - 1,
          this.places[index + 2] / 32767.5 - 1,
        );
        const left = Math.round(x);
        const top = Math.round(y);
        if (!(left >= 0 && top >= 0 && left + side <= width && top + side <= height)) continue;
        const color =
          (255 << 24) | (this.colors[index + 2] << 16) | (this.colors[index + 1] << 8) | this.colors[index];
        for (let row = top; row < top + side; row++) {
          for (let at = row * width + left; at < row * width + left + side; at++) {
            if (depth < nearest[at]) {
              nearest[at] = depth;
              pixels[at] = color;
            }
          }
        }
      }
      this.context.putImageData(image, 0, 0);
    }

    listen() {
      const { canvas, pointers } = this;
      const spread = () => {
        const [one, two] = [...pointers.values()];
        return Math.hypot(one.x - two.x, one.y - two.y);
      };
      canvas.addEventListener("pointerdown", (event) => {
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        canvas.setPointerCapture(event.pointerId);
        this.point(event);
      });
      canvas.addEventListener("pointermove", (event) => {
        const known = pointers.get(event.pointerId);
        if (!known) {
          this.point(event);
          return;
        }
        const before = pointers.size === 2 ? spread() : 0;
        const [dx, dy] = [event.clientX - known.x, event.clientY - known.y];
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        if (pointers.size === 2) zoom(spread() / Math.max(before, 1));
        else turn(dx / 150, dy / 150);
      });
      for (const end of ["pointerup", "pointercancel"]) {
        canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
      }
      canvas.addEventListener(
        "wheel",
        (event) => {
          if (document.activeElement !== canvas && !event.ctrlKey) return;
          event.preventDefault();
          zoom(Math.exp(-event.deltaY / 400));
        },
        { passive: false },
      );
      canvas.addEventListener("keydown", (event) => {
        const action = {
          ArrowLeft: () => turn(-0.15, 0),
          ArrowRight: () => turn(0.15, 0),
          ArrowUp: () => turn(0, -0.15),
          ArrowDown: () => turn(0, 0.15),
          "+": () => zoom(1.2),
          "=": () => zoom(1.2),
          "-": () => zoom(1 / 1.2),
        }[event.key];
        if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        action();
      });
    }

    point(event) {
      const box = this.canvas.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let found = "";
      let nearest = 16;
      for (const camera of this.cameras) {
        if (!camera.place) continue;
        const distance = Math.hypot(camera.place[0] - x, camera.place[1] - y);
        if (distance < nearest) [nearest, found] = [distance, camera.name];
      }
      if (found === pointedAt) return;
      pointedAt = found;
      for (const model of models) {
        const isHere = model.cameras.some((camera) => camera.name === found);
        model.readout.textContent = !found ? "\u00a0" : isHere ? found : `${found}: not registered`;
      }
      redraw();
    }
  }

  const models = [...document.querySelectorAll("canvas")].map((canvas) => new Model(canvas));
  const actions = {
    top: () => { Object.assign(eye, { yaw: 0, pitch: TOP, zoom: data.zoom }); redraw(); },
    side: () => { eye.pitch = 0.15; redraw(); },
    left: () => turn(-0.3, 0),
    right: () => turn(0.3, 0),
    in: () => zoom(1.3),
    out: () => zoom(1 / 1.3),
  };
  document.getElementById("view")?.addEventListener("click", (event) => {
    actions[event.target.closest("button")?.dataset.view]?.();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
})();
