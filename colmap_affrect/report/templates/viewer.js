"use strict";
// Models: all are turned together; each can be looked at through one of its photographs.
(() => {
  const { data, all, label, bytes, limited, cards, source, picture, open } = page;
  const [FRONT, TOP, DISTANCE, MAX_ZOOM] = [0.35, Math.PI / 2, 4, 20];
  const SIDE_PX = [300, 225];
  const SIDES = { front: [0, FRONT], side: [Math.PI / 2, 0], top: [0, TOP] };
  const [NEAR_PX, DRAG_PX, MAX_LABELLED, MAX_PICTURES] = [16, 6, 80, 200];
  const [POINT_PX, ARROW_PX, CROP_PX, CROP_SHARE] = [9, 40, 120, 0.12];
  const [MAX_WHILE_MOVING, REST_MS] = [60_000, 200]; // points that are drawn while a model is turned
  const [SEEN_COLOR, CHOSEN_COLOR] = [0xff00e0ff, "#ff2fd0"];
  const BEFORE_COLOR = [194, 87, 0];
  const eye = { yaw: 0, pitch: FRONT, zoom: 0, isMoved: false, size: 1, fade: 0.8, after: 0.5 };
  let pointedAt = -1;
  let isWaiting = false;
  let rest = 0; // timer, until which the model is being moved

  function turn(yaw, pitch) {
    eye.yaw += yaw;
    eye.pitch = limited(eye.pitch + pitch, -TOP, TOP);
    eye.isMoved = true;
    moves();
    redraw();
  }

  function zoom(factor) {
    eye.zoom = limited(eye.zoom * factor, 0.3, MAX_ZOOM);
    eye.isMoved = true;
    moves();
    redraw();
  }

  function look(pitch) {
    Object.assign(eye, { yaw: 0, pitch, zoom: 0, isMoved: false });
    redraw();
  }

  // Of many points some are enough while something moves; all follow at rest.
  function moves() {
    clearTimeout(rest);
    rest = setTimeout(() => {
      rest = 0;
      redraw();
    }, REST_MS);
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

  // By how many quarters a photograph is turned to the right to stand upright.
  function quartersOf({ rotation }) {
    const [right, down] = [rotation[2], rotation[5]]; // of the upright direction, z
    if (Math.abs(down) >= Math.abs(right)) return down > 0 ? 2 : 0;
    return right > 0 ? 3 : 1;
  }

  // Points and cameras, as models are drawn with.
  function contentOf(view) {
    const { count, cameras, points } = view;
    const buffer = bytes(points).buffer;
    return {
      count, cameras,
      places: Float32Array.from(new Uint16Array(buffer, 0, 3 * count), (p) => p / 32767.5 - 1),
      colors: new Uint8Array(buffer, 6 * count),
      drawn: cameras.filter((camera) => camera.index >= 0),
    };
  }

  class Model {
    constructor(canvas) {
      const view = data.views[canvas.dataset.model];
      this.content = contentOf(view);
      Object.assign(this, this.content);
      this.readTracks(view.tracks);
      this.before = canvas.dataset.before ? contentOf(data.views[canvas.dataset.before]) : null;
      this.before?.colors.forEach((_, at, colors) => (colors[at] = BEFORE_COLOR[at % 3]));
      this.canvas = canvas;
      this.context = canvas.getContext("2d");
      this.layer = document.createElement("canvas");
      this.panel = canvas.closest("figure");
      this.readout = this.panel.querySelector(".readout");
      this.preview = canvas.parentElement.querySelector(".preview");
      this.pointers = new Map();
      this.dragged = 0;
      this.size = null;
      this.through = null; // the camera that is looked through, and how its photograph lies
      this.chosen = -1; // point
      this.listen();
      this.drawSides();
      new ResizeObserver(refit).observe(canvas);
    }

    // Which cameras see each point, and where: shares of width and height.
    readTracks(text) {
      this.starts = new Uint32Array(this.count + 1);
      if (!text) return;
      const buffer = bytes(text).buffer;
      const counts = new Uint16Array(buffer, 0, this.count);
      for (let point = 0; point < this.count; point++) this.starts[point + 1] = this.starts[point] + counts[point];
      const total = this.starts[this.count];
      this.seers = new Uint16Array(buffer, 2 * this.count, total);
      this.seenAt = new Uint16Array(buffer, 2 * (this.count + total), 2 * total);
    }

    observations(point) {
      const found = [];
      for (let at = this.starts[point]; at < this.starts[point + 1]; at++) {
        const [x, y] = [this.seenAt[2 * at] / 65535, this.seenAt[2 * at + 1] / 65535];
        found.push({ camera: this.cameras[this.seers[at]], x, y });
      }
      return found.filter(({ camera }) => camera.index >= 0);
    }

    isSeenBy(camera) {
      const row = this.cameras.indexOf(camera);
      const seen = new Uint8Array(this.count);
      for (let point = 0; point < this.count; point++) {
        for (let at = this.starts[point]; at < this.starts[point + 1]; at++) {
          if (this.seers[at] === row) seen[point] = 1;
        }
      }
      return seen;
    }

    // Look through a photograph; with a place in it, shares of its sides, closely at that.
    lookThrough(index, place) {
      const camera = this.drawn.find((other) => other.index === index && other.look);
      if (!camera) return;
      const { look: seeing } = camera;
      const quarters = quartersOf(seeing);
      this.through = {
        camera, quarters, project: page.geometry.projector(seeing), seen: this.isSeenBy(camera),
        zoom: place ? 4 : 1, left: 0, top: 0,
      };
      if (place) this.center(place);
      this.mark(-1);
      showLook();
      redraw();
    }

    center({ x, y }) {
      const { width, height } = this.canvas.getBoundingClientRect();
      const [size, scale] = [this.through.camera.look.size, this.throughScale(width, height)];
      const [dx, dy] = this.turned((x - 0.5) * size[0], (y - 0.5) * size[1]);
      Object.assign(this.through, { left: -dx * scale, top: -dy * scale });
    }

    leave() {
      if (!this.through) return;
      this.through = null;
      showLook();
      redraw();
    }

    turned(dx, dy) {
      const turns = [[dx, dy], [-dy, dx], [-dx, -dy], [dy, -dx]];
      return turns[this.through.quarters];
    }

    // Px of the canvas for each px of the photograph.
    throughScale(width, height) {
      const { camera, quarters, zoom: closer } = this.through;
      const [wide, high] = quarters % 2 ? [...camera.look.size].reverse() : camera.look.size;
      return Math.min(width / wide, height / high) * closer;
    }

    projectionThrough(width, height, density) {
      const { camera, project, left, top } = this.through;
      const [wide, high] = camera.look.size;
      const scale = this.throughScale(width, height);
      return (x, y, z) => {
        const [u, v, depth] = project(x, y, z);
        const [dx, dy] = this.turned(u - wide / 2, v - high / 2);
        return [width / 2 + left * density + dx * scale, height / 2 + top * density + dy * scale, depth];
      };
    }

    projection(width, height, closer, density = 1) {
      if (this.through) return this.projectionThrough(width, height, density);
      const [sinYaw, cosYaw] = [Math.sin(eye.yaw), Math.cos(eye.yaw)];
      const [sinPitch, cosPitch] = [Math.sin(eye.pitch), Math.cos(eye.pitch)];
      const scale = (Math.min(width, height) / 2) * closer;
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
      const { through } = this;
      this.through = null;
      const project = this.projection(width, height, 1);
      this.through = through;
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
      const held = Math.max(...this.drawn.flatMap(({ corners }) =>
        [0, 3, 6, 9, 12].map((at) => reach(corners.slice(at, at + 3)))),
      points[Math.floor(0.9 * points.length)] ?? 0);
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
      const project = this.projection(width, height, eye.zoom, density);
      const isWhole = !this.through || this.through.zoom === 1;
      canvas.style.touchAction = isWhole ? "pan-y" : "none";
      if (this.before) this.drawBefore(project, width, height, density);
      this.drawPoints(project, width, height, density);
      if (this.through) this.drawPhotograph(width, height, density);
      else this.drawCameras(project, density);
      if (this.chosen >= 0) this.drawChosen(project, density);
      if (this.before) this.blend(width, height);
    }

    // The model of a run before, on a layer of its own.
    drawBefore(project, width, height, density) {
      const known = this.context;
      Object.assign(this.layer, { width, height });
      this.context = this.layer.getContext("2d");
      Object.assign(this, this.before);
      this.drawPoints(project, width, height, density);
      this.drawCameras(project, density);
      Object.assign(this, this.content, { context: known });
    }

    // Both as strongly in the middle of the slider, one alone at each end.
    blend(width, height) {
      const { context } = this;
      const now = this.now ??= document.createElement("canvas");
      Object.assign(now, { width, height });
      now.getContext("2d").drawImage(context.canvas, 0, 0);
      context.clearRect(0, 0, width, height);
      context.globalAlpha = Math.min(1, 2 - 2 * eye.after);
      context.drawImage(this.layer, 0, 0);
      context.globalAlpha = Math.min(1, 2 * eye.after);
      context.drawImage(now, 0, 0);
      context.globalAlpha = 1;
    }

    // Below the points, as it lies on the canvas.
    drawPhotograph(width, height, density) {
      const { context } = this;
      const { camera, quarters, left, top } = this.through;
      const [wide, high] = camera.look.size;
      const image = picture(camera.index, redraw);
      if (!image) return;
      const scale = this.throughScale(width, height);
      context.save();
      context.globalCompositeOperation = "destination-over";
      context.globalAlpha = eye.fade;
      context.translate(width / 2 + left * density, height / 2 + top * density);
      context.rotate((quarters * Math.PI) / 2);
      context.scale(scale, scale);
      context.drawImage(image, -wide / 2, -high / 2, wide, high);
      context.restore();
    }

    corners({ corners }) {
      const places = [corners.slice(0, 3)];
      for (let at = 3; at < 15; at += 3) {
        places.push([0, 1, 2].map((axis) => corners[axis] + eye.size * (corners[at + axis] - corners[axis])));
      }
      return places;
    }

    drawCameras(project, density) {
      const { context } = this;
      const style = getComputedStyle(document.documentElement);
      context.lineJoin = "round";
      context.font = `600 ${12 * density}px system-ui, sans-serif`;
      const labels = [];
      for (const camera of this.drawn) {
        const isPointedAt = camera.index === pointedAt;
        const places = this.corners(camera).map((place) => project(...place));
        camera.place = [places[0][0] / density, places[0][1] / density];
        if (!this.size && (isPointedAt || this.drawn.length <= MAX_PICTURES)) {
          this.drawInFrustum(camera, places, isPointedAt);
        }
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
        context.globalAlpha = isPointedAt ? 0.3 : 0.15;
        context.fill(new Path2D(`M${places.slice(1).map(([x, y]) => `${x} ${y}`).join("L")}Z`));
        context.globalAlpha = 1;
        labels.push([isPointedAt, camera.index + 1, ...camera.place]);
      }
      if (labels.length <= MAX_LABELLED) this.drawLabels(labels, density, style);
    }

    // In two triangles, each an affine map of half of the photograph.
    drawInFrustum(camera, places, isPointedAt) {
      const image = camera.look && picture(camera.index, redraw);
      if (!image) return;
      const { context } = this;
      const [wide, high] = [image.naturalWidth, image.naturalHeight];
      const [, one, two, three, four] = places;
      const halves = [[one, two, four, 0, 0], [three, four, two, wide, high]];
      for (const [at, across, down, x, y] of halves) {
        const sign = x ? -1 : 1;
        context.save();
        context.globalAlpha = isPointedAt ? 1 : eye.fade;
        context.beginPath();
        for (const [px, py] of [at, across, down]) context.lineTo(px, py);
        context.closePath();
        context.clip();
        context.transform(
          (sign * (across[0] - at[0])) / wide, (sign * (across[1] - at[1])) / wide,
          (sign * (down[0] - at[0])) / high, (sign * (down[1] - at[1])) / high, at[0], at[1]);
        context.drawImage(image, -x, -y);
        context.restore();
      }
    }

    drawChosen(project, density) {
      const { context } = this;
      const [x, y] = project(...this.places.subarray(3 * this.chosen, 3 * this.chosen + 3));
      context.strokeStyle = CHOSEN_COLOR;
      context.lineWidth = 2 * density;
      context.beginPath();
      if (!this.through) {
        for (const { camera } of this.observations(this.chosen)) {
          context.moveTo(x, y);
          context.lineTo(camera.place[0] * density, camera.place[1] * density);
        }
      }
      context.moveTo(x + POINT_PX * density, y);
      context.arc(x, y, POINT_PX * density, 0, 2 * Math.PI);
      context.stroke();
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
        const last = context.canvas.width - context.measureText(text).width;
        const place = [Math.min((x + 4) * density, last), (y - 4) * density];
        context.strokeText(text, ...place);
        context.fillText(text, ...place);
      }
    }

    // Points that the photograph sees which is looked through stand out from it.
    drawPoints(project, width, height, density) {
      const image = this.context.createImageData(width, height);
      const pixels = new Uint32Array(image.data.buffer);
      const nearest = new Float32Array(width * height).fill(Infinity);
      const usual = Math.max(1, Math.round(density * (width > 700 * density ? 2.2 : 1.6)));
      const { places, colors } = this;
      const seen = this.through?.seen;
      const step = rest ? Math.max(1, Math.ceil(this.count / MAX_WHILE_MOVING)) : 1;
      for (let index = 0; index < 3 * this.count; index += 3 * step) {
        const [x, y, depth] = project(places[index], places[index + 1], places[index + 2]);
        const isSeen = seen?.[index / 3];
        const side = isSeen ? Math.round(1.6 * usual) : usual;
        const left = Math.round(x - side / 2);
        const top = Math.round(y - side / 2);
        if (!(left >= 0 && top >= 0 && left + side <= width && top + side <= height)) continue;
        const color = isSeen ? SEEN_COLOR
          : (255 << 24) | (colors[index + 2] << 16) | (colors[index + 1] << 8) | colors[index];
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

    // The point of which the page knows who sees it, next to a place of the canvas.
    pointAt(x, y, near) {
      const { width, height } = this.canvas.getBoundingClientRect();
      const project = this.projection(width, height, eye.zoom);
      const seen = this.through?.seen;
      let [found, best] = [-1, near];
      for (let point = 0; point < this.count; point++) {
        if (this.starts[point + 1] === this.starts[point] || (seen && !seen[point])) continue;
        const [px, py] = project(...this.places.subarray(3 * point, 3 * point + 3));
        const far = Math.hypot(px - x, py - y);
        if (far < best) [best, found] = [far, point];
      }
      return found;
    }

    // Show who sees a point: a piece of each photograph, a click on which looks through that.
    choose(point) {
      this.chosen = point;
      const seen = this.panel.querySelector(".seen");
      if (!seen) return;
      const found = point < 0 ? [] : this.observations(point);
      seen.hidden = point < 0;
      seen.querySelector(".note").textContent =
        `This point is seen by ${found.length} photographs; click one to look at the point in it.`;
      seen.querySelector(".strip").replaceChildren(...found.map((one) => this.piece(one)));
      redraw();
    }

    piece({ camera, x, y }) {
      const button = document.createElement("button");
      const canvas = document.createElement("canvas");
      const name = Object.assign(document.createElement("span"), { textContent: label(camera.index) });
      Object.assign(button, { type: "button", className: `chip ${camera.kind}`, title: data.names[camera.index] });
      canvas.width = canvas.height = 2 * CROP_PX;
      name.className = "name";
      button.append(canvas, name);
      const context = canvas.getContext("2d");
      const draw = () => {
        const image = picture(camera.index, draw);
        if (!image) return;
        const [wide, high] = [image.naturalWidth, image.naturalHeight];
        const side = CROP_SHARE * Math.max(wide, high);
        const scale = (2 * CROP_PX) / side;
        context.drawImage(image, CROP_PX - x * wide * scale, CROP_PX - y * high * scale, wide * scale, high * scale);
        for (const [color, line] of [["#000000", 6], [CHOSEN_COLOR, 3]]) {
          Object.assign(context, { strokeStyle: color, lineWidth: line });
          context.beginPath();
          context.arc(CROP_PX, CROP_PX, 18, 0, 2 * Math.PI);
          context.stroke();
        }
      };
      draw();
      button.addEventListener("click", () => this.lookThrough(camera.index, { x, y }));
      return button;
    }

    closer(factor, x, y) {
      if (!this.through) {
        zoom(factor);
        return;
      }
      const { width, height } = this.canvas.getBoundingClientRect();
      const [fromX, fromY] = [(x ?? width / 2) - width / 2, (y ?? height / 2) - height / 2];
      const before = this.through.zoom;
      const after = limited(before * factor, 1, MAX_ZOOM);
      const { left, top } = this.through;
      Object.assign(this.through, {
        zoom: after,
        left: after === 1 ? 0 : fromX - ((fromX - left) * after) / before,
        top: after === 1 ? 0 : fromY - ((fromY - top) * after) / before,
      });
      redraw();
    }

    drag(dx, dy) {
      if (!this.through) {
        turn(dx / 150, dy / 150);
        return;
      }
      const { width, height } = this.canvas.getBoundingClientRect();
      const reach = (this.through.zoom - 1) / 2;
      this.through.left = limited(this.through.left + dx, -reach * width, reach * width);
      this.through.top = limited(this.through.top + dy, -reach * height, reach * height);
      redraw();
    }

    next(step) {
      const known = this.drawn.map((camera) => camera.index).sort((one, two) => one - two);
      const at = known.indexOf(this.through?.camera.index);
      this.lookThrough(known[(at + step + known.length) % known.length]);
    }

    click(x, y) {
      if (pointedAt >= 0 && this.drawn[0]?.look) this.lookThrough(pointedAt);
      else if (pointedAt >= 0) open(pointedAt);
      else this.choose(this.pointAt(x, y, POINT_PX));
    }

    listen() {
      const { canvas, pointers } = this;
      const spread = () => {
        const [one, two] = [...pointers.values()];
        return Math.hypot(one.x - two.x, one.y - two.y);
      };
      const placeOf = (event) => {
        const box = canvas.getBoundingClientRect();
        return [event.clientX - box.left, event.clientY - box.top];
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
        if (pointers.size === 2) this.closer(spread() / Math.max(before, 1));
        else this.drag(dx, dy);
      });
      canvas.addEventListener("pointerup", (event) => {
        if (this.dragged < DRAG_PX && pointers.size === 1) this.click(...placeOf(event));
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
          this.closer(Math.exp(-event.deltaY / 400), ...placeOf(event));
        },
        { passive: false },
      );
      canvas.addEventListener("keydown", (event) => {
        const arrow = (dx, dy) => () =>
          (this.through ? this.drag(-ARROW_PX * dx, -ARROW_PX * dy) : turn(0.15 * dx, 0.15 * dy));
        const { width, height } = canvas.getBoundingClientRect();
        const action = {
          ArrowLeft: arrow(-1, 0),
          ArrowRight: arrow(1, 0),
          ArrowUp: arrow(0, -1),
          ArrowDown: arrow(0, 1),
          "+": () => this.closer(1.2),
          "=": () => this.closer(1.2),
          "-": () => this.closer(1 / 1.2),
          " ": () => this.choose(this.pointAt(width / 2, height / 2, Math.max(width, height))),
          PageDown: () => this.next(1),
          PageUp: () => this.next(-1),
          Escape: this.through ? () => this.leave() : null,
        }[event.key];
        if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        event.stopPropagation();
        action();
      });
    }

    point(event) {
      const box = this.canvas.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let found = -1;
      let nearest = NEAR_PX;
      for (const camera of this.through ? [] : this.drawn) {
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
        const isHere = model.drawn.some((camera) => camera.index === index);
        const text = isHere ? fate : "not in this model";
        model.readout.textContent = index < 0 ? "\u00a0" : label(index) + (text ? `: ${text}` : "");
      }
      this.preview.hidden = index < 0 || !source(index);
      if (!this.preview.hidden) this.preview.src = source(index);
      redraw();
    }
  }

  const models = all("canvas[data-model]").map((canvas) => new Model(canvas));
  const leaveAll = () => models.forEach((model) => model.leave());
  const visible = () => models.filter((model) => model.canvas.clientWidth);
  const closer = (factor) => {
    const looking = visible().filter((model) => model.through);
    if (looking.length) looking.forEach((model) => model.closer(factor));
    else zoom(factor);
  };
  const outside = (action) => () => {
    leaveAll();
    action();
  };
  const actions = {
    front: outside(() => look(FRONT)),
    top: outside(() => look(TOP)),
    left: outside(() => turn(-0.3, 0)),
    right: outside(() => turn(0.3, 0)),
    in: () => closer(1.3),
    out: () => closer(1 / 1.3),
  };
  document.getElementById("view")?.addEventListener("click", (event) => {
    actions[event.target.closest("button")?.dataset.view]?.();
  });
  document.getElementById("chosen")?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    showModel(models[button.dataset.shows], models[button.dataset.shows].panel.hidden);
  });
  function showModel(model, isShown) {
    model.panel.hidden = !isShown;
    const button = document.querySelector(`[data-shows="${model.canvas.dataset.model}"]`);
    button?.setAttribute("aria-pressed", String(isShown));
  }

  document.getElementById("before-after")?.addEventListener("input", (event) => {
    eye.after = event.target.value / 100;
    redraw();
  });

  // Looking through photographs: a list, buttons, and the other scripts.
  const bar = document.getElementById("look");
  const list = bar?.querySelector("select");
  const lookButton = (name) => bar.querySelector(`[data-look="${name}"]`);
  const modelOf = (index) => models.find((model) =>
    model.drawn.some((camera) => camera.index === index && camera.look));
  function showLook() {
    if (!bar) return;
    const looking = models.find((model) => model.through);
    list.value = looking ? looking.through.camera.index : "";
    lookButton("next").disabled = lookButton("leave").disabled = !looking;
    if (!looking) return;
    const { index } = looking.through.camera;
    looking.readout.textContent = `Through ${label(index)}. ${cards[index]?.querySelector(".fate")?.textContent.trim() ?? ""}`;
  }
  page.looks = (index) => Boolean(modelOf(index));
  page.lookThrough = (index) => {
    const model = modelOf(index);
    if (!model) return;
    showModel(model, true);
    models.filter((other) => other !== model).forEach((other) => other.leave());
    model.lookThrough(index);
    model.canvas.scrollIntoView({ block: "nearest" });
    model.canvas.focus({ preventScroll: true });
  };
  if (bar) {
    const known = data.names.map((_, index) => index).filter(page.looks);
    list.append(new Option("none: from outside", ""), ...known.map((index) => new Option(label(index), index)));
    list.addEventListener("change", () => (list.value ? page.lookThrough(Number(list.value)) : leaveAll()));
    lookButton("next").addEventListener("click", () => models.find((model) => model.through)?.next(1));
    lookButton("leave").addEventListener("click", leaveAll);
    lookButton("fade").addEventListener("input", (event) => {
      eye.fade = event.target.value / 100;
      redraw();
    });
    for (const [name, factor] of [["larger", 1.6], ["smaller", 1 / 1.6]]) {
      lookButton(name).addEventListener("click", () => {
        eye.size = limited(eye.size * factor, 0.2, 16);
        redraw();
      });
    }
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
})();
