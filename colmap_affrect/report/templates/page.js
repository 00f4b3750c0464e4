"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const label = (index) => `${index + 1} ${data.names[index]}`;
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const limited = (value, low, high) => Math.min(Math.max(value, low), high);
  document.documentElement.classList.add("script");

  // Photographs: each is in the page once, on the contact sheet.
  const cards = all("#sheet > li");
  const source = (index) => cards[index]?.querySelector("img")?.src ?? "";

  const dialog = document.getElementById("photo");
  let opened = 0;
  function open(index) {
    if (!cards.length) return;
    opened = (index + cards.length) % cards.length;
    const image = dialog.querySelector("img");
    image.src = source(opened);
    image.hidden = !source(opened);
    image.alt = `Photograph ${opened + 1}`;
    const caption = cards[opened].querySelector("figcaption").cloneNode(true);
    dialog.querySelector(".caption").replaceChildren(...caption.childNodes);
    if (!dialog.open) dialog.showModal();
  }
  dialog.addEventListener("click", (event) => {
    const step = event.target.closest("button")?.dataset.step;
    if (event.target === dialog || step === "0") dialog.close();
    else if (step) open(opened + Number(step));
  });
  dialog.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) open(opened + step);
  });

  // Panels: one click makes them as large as the window.
  function enlarge(panel) {
    const isLarge = panel.classList.toggle("large");
    panel.querySelector(".enlarge").textContent = isLarge ? "Close" : "Enlarge";
    document.body.classList.toggle("covered", isLarge);
  }
  for (const caption of all("figure.panel > figcaption")) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", className: "enlarge script-only", textContent: "Enlarge" });
    caption.prepend(button);
  }
  document.addEventListener("click", (event) => {
    const photograph = event.target.closest("[data-open]");
    const large = event.target.closest(".enlarge, .panel > img");
    if (photograph) open(Number(photograph.dataset.open));
    else if (large) enlarge(large.closest(".panel"));
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !dialog.open) all(".panel.large").forEach(enlarge);
  });

  // Contact sheet: show the photographs of one group.
  const filters = document.getElementById("filters");
  filters?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    for (const other of all("button", filters)) {
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
    folded = all("details:not([open])");
    folded.forEach((item) => (item.open = true));
  });
  addEventListener("afterprint", () => folded.forEach((item) => (item.open = false)));

  // Matrix of inliers: colours of the classes, numbers in a few large cells, and that under the pointer.
  const MAX_NUMBERED = 14;
  function drawMatrix(svg, counts, size) {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = size;
    const context = canvas.getContext("2d");
    const texts = svg.querySelector(".counts");
    for (let cell = 0; cell < size * size; cell++) {
      const count = counts.getUint16(2 * cell, true);
      if (!count) continue;
      const [row, column] = [Math.floor(cell / size), cell % size];
      const kind = data.starts.filter((start) => count >= start).length - 1;
      context.fillStyle = data.colors[kind];
      context.fillRect(column, row, 1, 1);
      if (size > MAX_NUMBERED) continue;
      const text = document.createElementNS("http" + "://www.w3.org/2000/svg", "text");
      for (const [key, value] of Object.entries({ x: column, dx: 0.5, y: row, dy: 0.6, class: `on${kind}` })) {
        text.setAttribute(key, value);
      }
      text.textContent = count;
      texts.append(text);
    }
    svg.querySelector("image").setAttribute("href", canvas.toDataURL());
  }
  for (const matrix of all("[data-matrix]")) {
    const counts = new DataView(bytes(data.matrix).buffer);
    const readout = matrix.parentElement.querySelector(".readout");
    const size = data.names.length;
    drawMatrix(matrix, counts, size);
    const show = (event) => {
      const ground = matrix.querySelector(".ground").getBoundingClientRect();
      const column = Math.floor(((event.clientX - ground.left) / ground.width) * size);
      const row = Math.floor(((event.clientY - ground.top) / ground.height) * size);
      if (Math.min(row, column) < 0 || Math.max(row, column) >= size || row === column) {
        readout.textContent = "\u00a0";
        return;
      }
      const count = counts.getUint16(2 * (row * size + column), true);
      readout.textContent = `${label(row)} – ${label(column)}: ${count || "no"} inliers`;
    };
    matrix.addEventListener("pointermove", show);
    matrix.addEventListener("pointerdown", show);
  }

  // Models: all are seen from the same place, a camera pointed at is marked in all.
  const [FRONT, TOP, DISTANCE, MAX_ZOOM] = [0.35, Math.PI / 2, 4, 20];
  const SIDE_PX = [300, 225];
  const SIDES = { front: [0, FRONT], side: [Math.PI / 2, 0], top: [0, TOP] };
  const [NEAR_PX, DRAG_PX, MAX_LABELLED] = [16, 6, 80];
  const eye = { yaw: 0, pitch: FRONT, zoom: 0, isMoved: false };
  let pointedAt = -1;
  let isWaiting = false;

  function turn(yaw, pitch) {
    eye.yaw += yaw;
    eye.pitch = limited(eye.pitch + pitch, -TOP, TOP);
    eye.isMoved = true;
    redraw();
  }

  function zoom(factor) {
    eye.zoom = limited(eye.zoom * factor, 0.3, MAX_ZOOM);
    eye.isMoved = true;
    redraw();
  }

  function look(pitch) {
    Object.assign(eye, { yaw: 0, pitch, zoom: 0, isMoved: false });
    redraw();
  }

  function refit() {
    if (!eye.isMoved) eye.zoom = 0;
    redraw();
  }

  function redraw() {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      const visible = models.filter((model) => model.canvas.clientWidth);
      if (!visible.length) return;
      if (!eye.zoom) eye.zoom = Math.min(...visible.map((model) => model.fittingZoom()));
      visible.forEach((model) => model.draw());
    });
  }

  class Model {
    constructor(canvas) {
      const view = data.views[canvas.dataset.model];
      const buffer = bytes(view.points).buffer;
      this.count = view.count;
      this.places = Float32Array.from(new Uint16Array(buffer, 0, 3 * this.count), (p) => p / 32767.5 - 1);
      this.colors = new Uint8Array(buffer, 6 * this.count);
      this.cameras = view.cameras;
      this.canvas = canvas;
      this.context = canvas.getContext("2d");
      this.readout = canvas.parentElement.parentElement.querySelector(".readout");
      this.preview = canvas.parentElement.querySelector(".preview");
      this.pointers = new Map();
      this.dragged = 0;
      this.size = null;
      this.listen();
      this.drawSides();
      new ResizeObserver(refit).observe(canvas);
    }

    projection(width, height, zoom) {
      const [sinYaw, cosYaw] = [Math.sin(eye.yaw), Math.cos(eye.yaw)];
      const [sinPitch, cosPitch] = [Math.sin(eye.pitch), Math.cos(eye.pitch)];
      const scale = (Math.min(width, height) / 2) * zoom;
      return (x, y, z) => {
        const right = cosYaw * x - sinYaw * y;
        const away = sinYaw * x + cosYaw * y;
        const depth = DISTANCE + away * cosPitch - z * sinPitch;
        const size = depth > 0.2 ? (scale * DISTANCE) / depth : NaN;
        const up = away * sinPitch + z * cosPitch;
        return [width / 2 + right * size, height / 2 - up * size, depth];
      };
    }

    // With which all cameras and nine points of ten are inside.
    fittingZoom() {
      const [width, height] = this.size ?? [this.canvas.clientWidth, this.canvas.clientHeight];
      const project = this.projection(width, height, 1);
      const reach = (place) => {
        const [x, y] = project(...place);
        return Math.max(Math.abs((2 * x) / width - 1), Math.abs((2 * y) / height - 1));
      };
      const points = [];
      const step = 3 * Math.ceil(this.count / 1000);
      for (let index = 0; index < 3 * this.count; index += step) {
        points.push(reach(this.places.subarray(index, index + 3)));
      }
      points.sort((one, two) => one - two);
      const cameras = this.cameras.flatMap(({ corners }) =>
        [0, 3, 6, 9, 12].map((at) => reach(corners.slice(at, at + 3))));
      const held = Math.max(...cameras, points[Math.floor(0.9 * points.length)] ?? 0);
      return limited(0.9 / held || 1, 0.3, 4);
    }

    draw() {
      const { canvas, context } = this;
      const density = this.size ? 2 : Math.min(devicePixelRatio || 1, 2);
      const [width, height] = (this.size ?? [canvas.clientWidth, canvas.clientHeight])
        .map((length) => Math.round(length * density));
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) {
        canvas.width = width;
        canvas.height = height;
      }
      const project = this.projection(width, height, eye.zoom);
      this.drawPoints(project, width, height, density);
      const style = getComputedStyle(document.documentElement);
      context.lineJoin = "round";
      context.font = `600 ${12 * density}px system-ui, sans-serif`;
      const labels = [];
      for (const camera of this.cameras) {
        const isPointedAt = camera.index === pointedAt;
        const places = [];
        for (let at = 0; at < 15; at += 3) places.push(project(...camera.corners.slice(at, at + 3)));
        camera.place = [places[0][0] / density, places[0][1] / density];
        context.strokeStyle = style.getPropertyValue(`--${camera.kind}`);
        context.lineWidth = (isPointedAt ? 4 : 1.6) * density;
        context.beginPath();
        for (let corner = 1; corner < 5; corner++) {
          context.moveTo(places[0][0], places[0][1]);
          context.lineTo(places[corner][0], places[corner][1]);
          const next = places[(corner % 4) + 1];
          context.lineTo(next[0], next[1]);
        }
        context.stroke();
        context.fillStyle = context.strokeStyle;
        context.globalAlpha = isPointedAt ? 0.5 : 0.2;
        context.fill(new Path2D(`M${places.slice(1).map(([x, y]) => `${x} ${y}`).join("L")}Z`));
        context.globalAlpha = 1;
        labels.push([isPointedAt, camera.index + 1, ...camera.place]);
      }
      if (labels.length <= MAX_LABELLED) this.drawLabels(labels, density, style);
    }

    // For paper: drawn once, since pictures that are made when printing begins come too late.
    drawSides() {
      const known = [this.canvas, this.context, { ...eye }];
      document.documentElement.classList.add("printing");
      this.size = SIDE_PX;
      for (const image of all("[data-side]", known[0].closest("figure"))) {
        this.canvas = document.createElement("canvas");
        this.context = this.canvas.getContext("2d");
        [eye.yaw, eye.pitch] = SIDES[image.dataset.side];
        eye.zoom = this.fittingZoom();
        this.draw();
        image.src = this.canvas.toDataURL();
      }
      document.documentElement.classList.remove("printing");
      this.size = null;
      [this.canvas, this.context] = known;
      Object.assign(eye, known[2]);
    }

    drawLabels(labels, density, style) {
      const { context } = this;
      const drawn = [];
      labels.sort((one, two) => Number(two[0]) - Number(one[0]));
      for (const [, text, x, y] of labels) {
        if (drawn.some(([left, top]) => Math.abs(left - x) < 18 && Math.abs(top - y) < 13)) continue;
        drawn.push([x, y]);
        context.lineWidth = 3 * density;
        context.strokeStyle = style.getPropertyValue("--ground");
        context.fillStyle = style.getPropertyValue("--text");
        context.strokeText(text, (x + 4) * density, (y - 4) * density);
        context.fillText(text, (x + 4) * density, (y - 4) * density);
      }
    }

    drawPoints(project, width, height, density) {
      const image = this.context.createImageData(width, height);
      const pixels = new Uint32Array(image.data.buffer);
      const nearest = new Float32Array(width * height).fill(Infinity);
      const side = Math.max(1, Math.round(density * (width > 700 * density ? 2.2 : 1.6)));
      const { places, colors } = this;
      for (let index = 0; index < 3 * this.count; index += 3) {
        const [x, y, depth] = project(places[index], places[index + 1], places[index + 2]);
        const left = Math.round(x);
        const top = Math.round(y);
        if (!(left >= 0 && top >= 0 && left + side <= width && top + side <= height)) continue;
        const color =
          (255 << 24) | (colors[index + 2] << 16) | (colors[index + 1] << 8) | colors[index];
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
        this.dragged = 0;
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
        this.dragged += Math.hypot(dx, dy);
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        if (pointers.size === 2) zoom(spread() / Math.max(before, 1));
        else turn(dx / 150, dy / 150);
      });
      canvas.addEventListener("pointerup", () => {
        if (this.dragged < DRAG_PX && pointedAt >= 0) open(pointedAt);
      });
      for (const end of ["pointerup", "pointercancel"]) {
        canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
      }
      canvas.addEventListener("pointerleave", () => this.mark(-1));
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
      let found = -1;
      let nearest = NEAR_PX;
      for (const camera of this.cameras) {
        if (!camera.place) continue;
        const distance = Math.hypot(camera.place[0] - x, camera.place[1] - y);
        if (distance < nearest) [nearest, found] = [distance, camera.index];
      }
      this.mark(found);
    }

    mark(index) {
      if (index === pointedAt) return;
      pointedAt = index;
      const fate = cards[index]?.querySelector(".fate")?.textContent.trim();
      for (const model of models) {
        const isHere = model.cameras.some((camera) => camera.index === index);
        const text = isHere ? fate : "not registered";
        model.readout.textContent = index < 0 ? "\u00a0" : label(index) + (text ? `: ${text}` : "");
      }
      this.preview.hidden = index < 0 || !source(index);
      if (!this.preview.hidden) this.preview.src = source(index);
      redraw();
    }
  }

  const models = all("canvas[data-model]").map((canvas) => new Model(canvas));
  const actions = {
    front: () => look(FRONT),
    top: () => look(TOP),
    left: () => turn(-0.3, 0),
    right: () => turn(0.3, 0),
    in: () => zoom(1.3),
    out: () => zoom(1 / 1.3),
  };
  document.getElementById("view")?.addEventListener("click", (event) => {
    actions[event.target.closest("button")?.dataset.view]?.();
  });
  document.getElementById("chosen")?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const panel = models[button.dataset.shows].canvas.closest("figure");
    panel.hidden = !panel.hidden;
    button.setAttribute("aria-pressed", String(!panel.hidden));
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
})();
