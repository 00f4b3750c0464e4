"use strict";
// Which photographs match: the matrix of inliers, and what two photographs share.
(() => {
  const { data, all, label, bytes, picture } = page;
  const MAX_NUMBERED = 14;
  const inliers = data.matrix ? new DataView(bytes(data.matrix).buffer) : null;
  // Of a page of very many photographs, which has no matrix, null: nobody knows before.
  const countOf = (one, two) => inliers?.getUint16(2 * (one * data.names.length + two), true) ?? null;

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
    const readout = matrix.parentElement.querySelector(".readout");
    const size = data.names.length;
    drawMatrix(matrix, inliers, size);
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
      const count = countOf(...cell);
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
  let shown = [0, 1];

  // Lines of some pairs, from the page or from a file beside it.
  function take({ pairs, lines }) {
    const buffer = bytes(lines).buffer;
    const total = pairs.reduce((sum, [, , count]) => sum + count, 0);
    const values = new Uint16Array(buffer, 0, 4 * total);
    const kinds = new Uint8Array(buffer, 8 * total);
    let start = 0;
    for (const [one, two, count, text, isBacked] of pairs) {
      const found = { values, kinds, start, count, text, isBacked };
      known.set(`${one} ${two}`, { ...found, isTurned: false });
      known.set(`${two} ${one}`, { ...found, isTurned: true });
      start += count;
    }
  }
  take(data.pair_lines);

  // Files beside the page have the pairs that are not in it, in order; each is a script, since a
  // page on a disk can read nothing else.
  const files = data.pair_files ?? [];
  const asked = new Map();
  const isAtOrBefore = (file, low, high) => file[1] < low || (file[1] === low && file[2] <= high);
  function fileOf(one, two) {
    const [low, high] = [Math.min(one, two), Math.max(one, two)];
    return files.findLast((file) => isAtOrBefore(file, low, high))?.[0];
  }
  function read(name) {
    if (!asked.has(name)) {
      asked.set(name, new Promise((resolve) => {
        const script = document.createElement("script");
        script.addEventListener("load", () => resolve(true));
        script.addEventListener("error", () => {
          asked.delete(name);
          script.remove();
          resolve(false);
        });
        script.src = name;
        document.head.append(script);
      }));
    }
    return asked.get(name);
  }
  page.takePairs = take;

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
        return [x + (lines.values[from] / 65535) * wide, y + (lines.values[from + 1] / 65535) * high];
      });
      context.strokeStyle = context.fillStyle = data.line_colors[lines.kinds[row]];
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

  function textOf(one, two) {
    const lines = known.get(`${one} ${two}`);
    if (lines?.isBacked) return `${lines.text}; ${lines.count} of them are drawn.`;
    if (lines) return `${lines.text}; ${lines.count} of them are drawn. Where they are wrong, run again with:`;
    const isComplete = !data.num_pairs_left_out || countOf(one, two) === 0;
    return isComplete ? "They share no verified match. What was rejected, if anything, is drawn by:" : "They share matches that this page leaves out; the command below draws them.";
  }

  async function showPair(one, two) {
    const isInFile = !known.has(`${one} ${two}`) && countOf(one, two) !== 0;
    const name = isInFile ? fileOf(one, two) : undefined;
    showFigure(one, two, name ? "Reading what they share." : textOf(one, two));
    if (!name) return;
    const isRead = await read(name);
    if (shown[0] !== one || shown[1] !== two) return;
    const lacking = `Not found: ${name}. It belongs beside this page; copy it there, and click again.`;
    showFigure(one, two, isRead ? textOf(one, two) : lacking);
  }

  function showFigure(one, two, text) {
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
    figure.querySelector(".readout").textContent = text;
    figure.querySelector("code").hidden = Boolean(lines?.isBacked);
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
