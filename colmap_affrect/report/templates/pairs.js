"use strict";
// Which photographs match: the matrix of inliers, and what two photographs share.
(() => {
  const { data, all, label, bytes, picture } = page;
  const MAX_NUMBERED = 14;

  // Colours of the classes, numbers in a few large cells, and that under the pointer.
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
    const cellAt = (event) => {
      const ground = matrix.querySelector(".ground").getBoundingClientRect();
      const column = Math.floor(((event.clientX - ground.left) / ground.width) * size);
      const row = Math.floor(((event.clientY - ground.top) / ground.height) * size);
      const isCell = Math.min(row, column) >= 0 && Math.max(row, column) < size && row !== column;
      return isCell ? [row, column] : null;
    };
    const show = (event) => {
      const cell = cellAt(event);
      if (!cell) {
        readout.textContent = "\u00a0";
        return;
      }
      const count = counts.getUint16(2 * (cell[0] * size + cell[1]), true);
      readout.textContent = `${label(cell[0])} – ${label(cell[1])}: ${count || "no"} inliers`;
    };
    matrix.addEventListener("pointermove", show);
    matrix.addEventListener("pointerdown", show);
    matrix.addEventListener("click", (event) => {
      const cell = cellAt(event);
      if (cell) showPair(...cell);
    });
  }

  // Two photographs side by side, or below each other on a phone, with lines between them.
  const figure = document.getElementById("pair");
  if (!figure) return;
  const canvas = figure.querySelector("canvas");
  const lists = all("#pair-choice select");
  const [GAP_PX, DOT_PX] = [8, 2.5];
  const known = new Map();
  const ends = { values: null, kinds: null };
  let shown = [0, 1];
  (() => {
    const buffer = bytes(data.pair_lines.lines).buffer;
    const total = data.pair_lines.pairs.reduce((sum, [, , count]) => sum + count, 0);
    ends.values = new Uint16Array(buffer, 0, 4 * total);
    ends.kinds = new Uint8Array(buffer, 8 * total);
    let start = 0;
    for (const [one, two, count, text] of data.pair_lines.pairs) {
      known.set(`${one} ${two}`, { start, count, text, isTurned: false });
      known.set(`${two} ${one}`, { start, count, text, isTurned: true });
      start += count;
    }
  })();

  const asCell = (name) => (/[",]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name);
  const forShell = (text) => (/^[\w.,/-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\"'\"'")}'`);

  function draw() {
    const width = canvas.clientWidth;
    const images = shown.map((index) => picture(index, draw));
    if (!width || !images.every(Boolean)) return;
    const isBelow = width < 500;
    const places = [];
    let [left, top, height] = [0, 0, 0];
    for (const image of images) {
      const wide = isBelow ? width : (width - GAP_PX) / 2;
      const high = (wide * image.naturalHeight) / image.naturalWidth;
      places.push([left, top, wide, high]);
      if (isBelow) top += high + GAP_PX;
      else left += wide + GAP_PX;
      height = isBelow ? top - GAP_PX : Math.max(height, high);
    }
    const density = Math.min(devicePixelRatio || 1, 2);
    [canvas.width, canvas.height] = [Math.round(width * density), Math.round(height * density)];
    canvas.style.aspectRatio = `${width} / ${height}`;
    const context = canvas.getContext("2d");
    context.scale(density, density);
    images.forEach((image, side) => context.drawImage(image, ...places[side]));
    const lines = known.get(shown.join(" "));
    if (!lines) return;
    for (let row = lines.start; row < lines.start + lines.count; row++) {
      const at = [0, 1].map((side) => {
        const from = 4 * row + 2 * (lines.isTurned ? 1 - side : side);
        const [x, y, wide, high] = places[side];
        return [x + (ends.values[from] / 65535) * wide, y + (ends.values[from + 1] / 65535) * high];
      });
      context.strokeStyle = context.fillStyle = data.line_colors[ends.kinds[row]];
      context.lineWidth = 1;
      context.globalAlpha = 0.7;
      context.beginPath();
      context.moveTo(...at[0]);
      context.lineTo(...at[1]);
      context.stroke();
      context.globalAlpha = 1;
      for (const place of at) {
        context.beginPath();
        context.arc(...place, DOT_PX, 0, 2 * Math.PI);
        context.fill();
      }
    }
  }

  function showPair(one, two) {
    shown = [one, two];
    lists.forEach((list, side) => (list.value = shown[side]));
    const lines = known.get(`${one} ${two}`);
    const names = shown.map((index) => data.names[index]);
    const caption = figure.querySelector("figcaption");
    caption.querySelector("strong")?.remove();
    caption.append(Object.assign(document.createElement("strong"), {
      textContent: `${label(one)} and ${label(two)}`,
    }));
    figure.hidden = false;
    canvas.setAttribute("aria-label", `Matches of ${label(one)} and ${label(two)}`);
    const text = lines ? `${lines.text}; ${lines.count} of them are drawn.` : "They share no verified match, or none is in this page.";
    figure.querySelector(".readout").textContent = text;
    figure.querySelector("code").textContent = lines
      ? `--reject-pair ${forShell(names.map(asCell).join())}`
      : `colmap-affrect show-pair OUT ${names.map(forShell).join(" ")}`;
    draw();
    figure.scrollIntoView({ block: "nearest" });
  }
  page.showPair = showPair;

  lists.forEach((list, side) => {
    list.append(...data.names.map((_, index) => new Option(label(index), index)));
    list.value = Math.min(side, data.names.length - 1);
    list.addEventListener("change", () => {
      const [one, two] = lists.map((other) => Number(other.value));
      if (one !== two) showPair(one, two);
    });
  });
  new ResizeObserver(draw).observe(canvas);
})();
