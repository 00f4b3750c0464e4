"use strict";
// Masks: a person covers parts of photographs and saves them as the folder of --mask-path.
(() => {
  const { data, label, picture, limited } = page;
  const { photographs } = data.tie_points; // [name, width, height] as stored, or null
  const STORED = `colmap-affrect masks ${data.masks_key}`;
  const COVER = "rgb(200 0 80 / 60%)";
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const STEP = 0.01; // of the longer side, by a key
  const section = document.getElementById("masks");
  const part = (name) => section.querySelector(`[data-part="${name}"]`);
  const canvas = section.querySelector("canvas");
  const context = canvas.getContext("2d");
  const list = part("photo");
  const usable = [...photographs.keys()].filter((photo) => photographs[photo]);
  const say = (text) => (part("said").textContent = text);

  // Strokes of a photograph: tool, width and places in px of the photograph.
  let strokes = {};
  try {
    strokes = JSON.parse(localStorage.getItem(STORED)) ?? {};
  } catch {
    strokes = {};
  }
  let photo = usable[0];
  let drawn = null; // the stroke that is being drawn
  let cross = null; // place of the cross of the keyboard
  const masked = () => usable.filter((other) => strokes[other]?.length);

  function keep() {
    try {
      localStorage.setItem(STORED, JSON.stringify(strokes));
    } catch {
      say("This browser does not keep what you paint: save before you leave the page.");
    }
  }

  function paint(target, { tool, width, places }) {
    const [[x, y], [endX, endY]] = [places[0], places.at(-1)];
    target.globalCompositeOperation = tool === "eraser" ? "destination-out" : "source-over";
    if (tool === "box") {
      target.fillRect(Math.min(x, endX), Math.min(y, endY), Math.abs(endX - x), Math.abs(endY - y));
    } else {
      Object.assign(target, { lineWidth: width, lineCap: "round", lineJoin: "round" });
      target.beginPath();
      target.moveTo(x, y);
      places.forEach((place) => target.lineTo(...place));
      target.lineTo(endX, endY + 0.01);
      target.stroke();
    }
    target.globalCompositeOperation = "source-over";
  }

  // A canvas of some size with what is covered in one colour; clear where nothing is.
  function cover(of, width, height, color, more = []) {
    const layer = document.createElement("canvas");
    [layer.width, layer.height] = [width, height];
    const target = layer.getContext("2d");
    target.scale(width / photographs[of][1], height / photographs[of][2]);
    target.fillStyle = target.strokeStyle = color;
    [...(strokes[of] ?? []), ...more].forEach((stroke) => paint(target, stroke));
    return layer;
  }

  function draw() {
    const [, width, height] = photographs[photo];
    canvas.style.aspectRatio = `${width} / ${height}`;
    canvas.style.maxWidth = `${(75 * width) / height}vh`; // the whole photograph is in the window
    const wide = canvas.clientWidth;
    if (!wide) return;
    const density = devicePixelRatio || 1;
    canvas.width = Math.round(wide * density);
    canvas.height = Math.round((canvas.width * height) / width);
    const image = picture(photo, draw);
    if (image) context.drawImage(image, 0, 0, canvas.width, canvas.height);
    const layer = cover(photo, canvas.width, canvas.height, "#c80050", drawn ? [drawn] : []);
    context.globalAlpha = 0.6;
    context.drawImage(layer, 0, 0);
    context.globalAlpha = 1;
    if (!cross) return;
    const [x, y] = [(cross[0] * canvas.width) / width, (cross[1] * canvas.height) / height];
    Object.assign(context, { strokeStyle: COVER, lineWidth: 2 * density });
    context.beginPath();
    context.moveTo(x - 15 * density, y);
    context.lineTo(x + 15 * density, y);
    context.moveTo(x, y - 15 * density);
    context.lineTo(x, y + 15 * density);
    context.stroke();
  }

  function choose(chosen) {
    [photo, drawn, cross] = [chosen, null, null];
    list.value = photo;
    canvas.setAttribute("aria-label", `Mask of photograph ${label(photo)}`);
    show();
  }

  function show() {
    part("undo").disabled = !strokes[photo]?.length;
    part("save").disabled = !masked().length;
    part("save-one").disabled = !strokes[photo]?.length;
    [...list.options].forEach((option) => {
      const index = Number(option.value);
      option.text = label(index) + (strokes[index]?.length ? " (masked)" : "");
    });
    draw();
  }

  function finish() {
    if (!drawn) return;
    (strokes[photo] ??= []).push(drawn);
    drawn = null;
    part("saved").hidden = true;
    say(`Masks: ${masked().length} of ${usable.length} photographs.`);
    keep();
    show();
  }

  function undo() {
    strokes[photo]?.pop();
    keep();
    show();
  }

  function placeOf(event) {
    const box = canvas.getBoundingClientRect();
    const [, width, height] = photographs[photo];
    const x = limited((event.clientX - box.left) / box.width, 0, 1) * width;
    const y = limited((event.clientY - box.top) / box.height, 0, 1) * height;
    return [Math.round(x), Math.round(y)];
  }

  function begun(place) {
    const longer = Math.max(photographs[photo][1], photographs[photo][2]);
    return {
      tool: part("tool").value,
      width: Math.round((part("width").value / 100) * longer),
      places: [place],
    };
  }

  canvas.addEventListener("pointerdown", (event) => {
    if (event.button || drawn) return;
    canvas.setPointerCapture(event.pointerId);
    drawn = begun(placeOf(event));
    draw();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!drawn || !canvas.hasPointerCapture(event.pointerId)) return;
    drawn.places.push(placeOf(event));
    if (drawn.tool === "box") drawn.places.splice(1, drawn.places.length - 2);
    draw();
  });
  canvas.addEventListener("pointerup", finish);
  canvas.addEventListener("pointercancel", () => {
    drawn = null;
    draw();
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const [, width, height] = photographs[photo];
    cross ??= [width / 2, height / 2];
    const step = STEP * Math.max(width, height) * (event.shiftKey ? 5 : 1);
    if (event.key === " ") {
      if (drawn) finish();
      else drawn = { tool: "box", width: 0, places: [[...cross], [...cross]] };
    } else if (ARROWS[event.key]) {
      const [dx, dy] = ARROWS[event.key];
      cross = [limited(cross[0] + dx * step, 0, width), limited(cross[1] + dy * step, 0, height)];
      if (drawn) drawn.places[1] = [...cross];
    } else return;
    event.preventDefault();
    draw();
  });
  section.addEventListener("keydown", (event) => {
    if (event.key !== "z" || !(event.ctrlKey || event.metaKey)) return;
    event.preventDefault();
    undo();
  });

  // PNG, white and black where it is covered, of the size of the photograph.
  function png(of) {
    const [, width, height] = photographs[of];
    const whole = document.createElement("canvas");
    [whole.width, whole.height] = [width, height];
    const target = whole.getContext("2d");
    target.fillStyle = "#ffffff";
    target.fillRect(0, 0, width, height);
    target.drawImage(cover(of, width, height, "#000000"), 0, 0);
    return new Promise((resolve) => whole.toBlob(resolve, "image/png"));
  }

  // Checksum of a ZIP file.
  const CRC = Uint32Array.from({ length: 256 }, (_, value) => {
    let found = value;
    for (let bit = 0; bit < 8; bit++) found = found & 1 ? (found >>> 1) ^ 0xedb88320 : found >>> 1;
    return found;
  });
  function checksum(content) {
    let found = 0xffffffff;
    for (const byte of content) found = CRC[(found ^ byte) & 255] ^ (found >>> 8);
    return (found ^ 0xffffffff) >>> 0;
  }

  // A ZIP file of [name, bytes], stored as they are.
  function zip(files) {
    const numbers = (...pairs) => {
      const view = new DataView(new ArrayBuffer(pairs.reduce((sum, [, size]) => sum + size, 0)));
      let at = 0;
      for (const [value, size] of pairs) {
        if (size === 4) view.setUint32(at, value, true);
        else view.setUint16(at, value, true);
        at += size;
      }
      return new Uint8Array(view.buffer);
    };
    const [UTF8, DATE] = [1 << 11, (1 << 5) | 1]; // names are UTF-8; 1 January 1980
    const [parts, index] = [[], []];
    let [offset, indexSize] = [0, 0];
    for (const [name, content] of files) {
      const path = new TextEncoder().encode(name);
      const shared = [[20, 2], [UTF8, 2], [0, 2], [0, 2], [DATE, 2], [checksum(content), 4],
        [content.length, 4], [content.length, 4], [path.length, 2], [0, 2]];
      const head = numbers([0x04034b50, 4], ...shared);
      const entry = numbers([0x02014b50, 4], [20, 2], ...shared, [0, 2], [0, 2], [0, 2], [0, 4], [offset, 4]);
      parts.push(head, path, content);
      index.push(entry, path);
      offset += head.length + path.length + content.length;
      indexSize += entry.length + path.length;
    }
    const end = numbers([0x06054b50, 4], [0, 2], [0, 2], [files.length, 2], [files.length, 2],
      [indexSize, 4], [offset, 4], [0, 2]);
    return new Blob([...parts, ...index, end], { type: "application/zip" });
  }

  function download(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }

  async function save() {
    const files = [];
    for (const of of masked()) {
      const content = new Uint8Array(await (await png(of)).arrayBuffer());
      files.push([`masks/${photographs[of][0]}.png`, content]);
    }
    download(zip(files), "masks.zip");
    part("saved").hidden = false;
    say(`Masks in masks.zip: ${files.length}.`);
  }

  // For a server that maps again: PNG in base64, by the name of the photograph.
  async function pictures() {
    const found = {};
    for (const of of masked()) {
      const content = new Uint8Array(await (await png(of)).arrayBuffer());
      found[photographs[of][0]] = btoa(Array.from(content, (byte) => String.fromCharCode(byte)).join(""));
    }
    return found;
  }
  page.masks = {
    pictures,
    open(index) {
      section.querySelector("details").open = true;
      choose(index);
      section.scrollIntoView();
    },
  };

  list.append(...usable.map((index) => new Option(label(index), index)));
  list.addEventListener("change", () => choose(Number(list.value)));
  part("next").addEventListener("click", () => choose(usable[(usable.indexOf(photo) + 1) % usable.length]));
  part("undo").addEventListener("click", undo);
  part("save").addEventListener("click", save);
  part("save-one").addEventListener("click", async () =>
    download(await png(photo), `${photographs[photo][0].split("/").pop()}.png`));
  new ResizeObserver(draw).observe(canvas);
  choose(photo);
})();
