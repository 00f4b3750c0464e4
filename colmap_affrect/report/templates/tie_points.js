"use strict";
// Tie points: a person marks the same places in photographs and saves them for --tie-points.
(() => {
  const { data } = page;
  // [name, width, height] of photographs as stored, or null; [point, photograph, x, y, residual].
  const { photographs, marks: ofRun, key } = data.tie_points;
  const { projector, meeting, epipolarLine } = page.geometry;
  const [DRAG_PX, ARROW_PX, MAX_SCALE] = [6, 40, 32];
  const [CURRENT_COLOR, COLOR, EXPECTED_COLOR] = ["#ffe000", "#7fe3ff", "#ff2fd0"];
  const STORED = `colmap-affrect tie points ${key}`;
  const NUM_HEAD_BYTES = 1 << 18;
  const FILE_NAME = "tie-points.csv";
  const COLUMNS = ["point", "photograph", "x", "y"];
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  const section = document.getElementById("tie-points");
  const part = (name) => section.querySelector(`[data-part="${name}"]`);
  const cards = [...document.querySelectorAll("#sheet > li")];
  const label = (photo) => `${photo + 1} ${data.names[photo]}`;
  const isLost = (photo) => cards[photo].dataset.groups.split(" ").includes("missing");
  const usable = [...photographs.keys()].filter((photo) => photographs[photo]);
  const distance = (one, two) => Math.hypot(one.x - two.x, one.y - two.y);
  const limited = (value, low, high) => Math.min(Math.max(value, low), high);
  const say = (text) => (part("said").textContent = text);

  // Marks: x and y are px from the upper left corner; the centre of the first pixel is 0.5, 0.5.
  let marks = ofRun.map(([point, photo, x, y, error]) => ({ point, photo, x, y, error }));
  let current = unused();
  let isSaved = true;
  let isKept = true;
  const past = [];
  const points = () => [...new Set(marks.map((mark) => mark.point))];
  const markOf = (point, photo) => marks.find((mark) => mark.point === point && mark.photo === photo);
  const ordered = () => points().flatMap((point) => marks.filter((mark) => mark.point === point));

  // How photographs see the model that they are in, by their numbers.
  const looks = new Map();
  data.views.forEach(({ cameras }, model) => {
    for (const { index, look } of cameras) {
      if (look && !looks.has(index)) looks.set(index, { ...look, model });
    }
  });

  // Marks of a point in photographs of one model, which tell where it is there.
  function sightsOf(point, model) {
    const seen = marks.filter((mark) => mark.point === point && looks.get(mark.photo)?.model === model);
    return seen.map(({ photo, x, y }) => ({ look: looks.get(photo), photo, x, y }));
  }

  // Where a point should be in a photograph: a place, or lines that it is on. Null: nobody knows.
  function expected(point, photo) {
    const look = looks.get(photo);
    const sights = look ? sightsOf(point, look.model).filter((sight) => sight.photo !== photo) : [];
    if (!sights.length) return null;
    const place = sights.length > 1 ? meeting(sights) : null;
    if (place) {
      const [x, y] = projector(look)(...place);
      return Number.isFinite(x) ? { place: { x, y }, lines: [] } : null;
    }
    return { place: null, lines: sights.map((sight) => epipolarLine(sight, look)) };
  }

  // How far a mark is from where all marks of its point say; undefined where they say nothing.
  function residual({ point, photo, x, y }) {
    const look = looks.get(photo);
    const sights = look ? sightsOf(point, look.model) : [];
    const place = sights.length > 1 ? meeting(sights) : null;
    if (!place) return undefined;
    const [seenX, seenY] = projector(look)(...place);
    return Number.isFinite(seenX) ? Math.hypot(seenX - x, seenY - y) : undefined;
  }

  // Browsers keep marks over a reload, where they are allowed to.
  function keep() {
    try {
      localStorage.setItem(STORED, JSON.stringify({ marks, current }));
    } catch {
      isKept = false;
    }
  }

  function kept() {
    try {
      return JSON.parse(localStorage.getItem(STORED));
    } catch {
      return null;
    }
  }

  function unused() {
    let number = 1;
    while (marks.some((mark) => mark.point === String(number))) number++;
    return String(number);
  }

  function change(changed, said) {
    past.push([marks, current]);
    [marks, isSaved] = [changed, false];
    say(said);
    keep();
    show();
  }

  function place(photo, x, y) {
    const [known, mark] = [markOf(current, photo), { point: current, photo, x, y }];
    const changed = known ? marks.map((other) => (other === known ? mark : other)) : [...marks, mark];
    change(changed, `Point ${current} in ${label(photo)}: x ${x.toFixed(2)}, y ${y.toFixed(2)}.`);
  }

  function remove(mark) {
    const others = marks.filter((other) => other !== mark);
    if (mark) change(others, `Point ${mark.point} in ${label(mark.photo)}: deleted.`);
  }

  function undo() {
    if (!past.length) return;
    [[marks, current], isSaved] = [past.pop(), false];
    keep();
    show();
  }

  function choose(point) {
    current = point;
    show();
  }

  function next() {
    const names = points();
    if (names.includes(current)) choose(names[names.indexOf(current) + 1] ?? unused());
  }

  // Pictures: small ones of the page, or originals from disk.
  let originals = [];
  const fileName = (photo) => photographs[photo][0].split("/").pop();

  // By the end of its path, or by its name if only one photograph and one file have it.
  function original(photo) {
    const path = (file) => `/${file.webkitRelativePath || file.name}`;
    const found = originals.find((file) => path(file).endsWith(`/${photographs[photo][0]}`));
    const files = originals.filter((file) => file.name === fileName(photo));
    const named = usable.filter((other) => fileName(other) === fileName(photo));
    return found ?? (files.length === 1 && named.length === 1 ? files[0] : null);
  }

  async function smallPicture(photo) {
    const image = cards[photo].querySelector("img")?.cloneNode();
    if (image) image.loading = "eager";
    await image?.decode();
    return image;
  }

  // Browsers turn images by EXIF whatever they are asked for: hide it in a copy, of JPEG and PNG.
  async function withoutExif(file) {
    const head = new Uint8Array(await file.slice(0, NUM_HEAD_BYTES).arrayBuffer());
    const text = new TextDecoder("latin1").decode(head);
    for (const { index } of text.matchAll(/Exif\0\0|eXIf/g)) head[index + 3] = "x".charCodeAt(0);
    return new Blob([head, file.slice(NUM_HEAD_BYTES)]);
  }

  async function originalPicture(photo) {
    const [file, [, width, height]] = [original(photo), photographs[photo]];
    if (!file) return null;
    try {
      const image = await createImageBitmap(await withoutExif(file));
      if (Math.abs(image.width * height - image.height * width) <= Math.max(width, height)) return image;
      say(`${file.name}: has another shape than in the run; mark in the small picture.`);
    } catch {
      say(`${file.name}: this browser cannot show it; mark in the small picture.`);
    }
    return null;
  }

  class Pane {
    constructor(figure, photo) {
      this.canvas = figure.querySelector("canvas");
      this.context = this.canvas.getContext("2d");
      this.list = figure.querySelector("select");
      this.readout = figure.querySelector(".readout");
      this.pointers = new Map();
      this.dragged = 0;
      const fate = (index) => (isLost(index) ? " (not placed)" : "");
      const option = (index) => new Option(label(index) + fate(index), index);
      this.list.append(...usable.map(option));
      this.list.addEventListener("change", () => this.load(Number(this.list.value)));
      figure.addEventListener("click", (event) => this.actions[event.target.dataset.act]?.());
      this.listen();
      new ResizeObserver(() => this.draw()).observe(this.canvas);
      this.load(photo);
    }

    // Of buttons and keys.
    actions = {
      "+": () => this.zoom(1.5),
      "=": () => this.zoom(1.5),
      "-": () => this.zoom(1 / 1.5),
      whole: () => this.zoom(0),
      expected: () => this.seek(),
      e: () => this.seek(),
      " ": () => this.mark(this.middle),
      Delete: () => remove(markOf(current, this.photo)),
      Enter: next,
    };

    async load(photo) {
      if (photo !== this.photo) this.isWhole = true;
      [this.photo, this.list.value] = [photo, photo];
      [, this.width, this.height] = photographs[photo];
      this.canvas.setAttribute("aria-label", `Photograph ${label(photo)}`);
      this.use(null);
      for (const read of [smallPicture, originalPicture]) {
        const image = await read(photo);
        if (image && photo === this.photo) this.use(image);
      }
    }

    use(image) {
      this.image?.close?.();
      this.image = image;
      this.draw();
    }

    // View: px of the screen per px of the original, and where its upper left corner is.
    zoom(factor, { x, y } = this.middle) {
      const whole = this.wholeScale;
      const scale = limited(this.scale * factor, whole, Math.max(whole, MAX_SCALE));
      this.left = x - ((x - this.left) * scale) / this.scale;
      this.top = y - ((y - this.top) * scale) / this.scale;
      this.scale = scale;
      this.isWhole = scale === whole;
      this.draw();
    }

    get middle() {
      const { width, height } = this.canvas.getBoundingClientRect();
      return { x: width / 2, y: height / 2 };
    }

    get wholeScale() {
      return 2 * Math.min(this.middle.x / this.width, this.middle.y / this.height);
    }

    pan(dx, dy) {
      const { x, y } = this.middle;
      this.left = limited(this.left + dx, x - this.width * this.scale, x);
      this.top = limited(this.top + dy, y - this.height * this.scale, y);
      this.draw();
    }

    look(mark) {
      this.zoom(Math.max(1, (4 * this.wholeScale) / this.scale));
      const { x, y } = this.onCanvas(mark);
      this.pan(this.middle.x - x, this.middle.y - y);
    }

    // Go to where the current point should be, closely enough to mark it.
    seek() {
      const should = expected(current, this.photo);
      const place = should?.place ?? should?.lines[0]?.find(([x, y]) => this.isInside(x, y));
      if (!place) {
        say(`Point ${current}: mark it in two photographs of the model, then this one can tell where it is.`);
        return;
      }
      this.look(should.place ?? { x: place[0], y: place[1] });
    }

    isInside(x, y) {
      return Math.min(x, y) >= 0 && x <= this.width && y <= this.height;
    }

    onCanvas({ x, y }) {
      return { x: this.left + x * this.scale, y: this.top + y * this.scale };
    }

    // Mark a place of the canvas, unless it is beside the photograph.
    mark(at) {
      const [x, y] = [(at.x - this.left) / this.scale, (at.y - this.top) / this.scale];
      if (this.isInside(x, y)) place(this.photo, x, y);
    }

    // By px of the original, or the photograph where there is no mark.
    move(dx, dy) {
      const mark = markOf(current, this.photo);
      const [x, y] = [mark?.x + dx, mark?.y + dy];
      if (!mark) this.pan(-ARROW_PX * dx, -ARROW_PX * dy);
      else place(this.photo, limited(x, 0, this.width), limited(y, 0, this.height));
    }

    draw() {
      const { canvas, context } = this;
      const { width, height } = canvas.getBoundingClientRect();
      if (!width || !height) return;
      if (this.isWhole) {
        this.scale = this.wholeScale;
        this.left = (width - this.width * this.scale) / 2;
        this.top = (height - this.height * this.scale) / 2;
      }
      canvas.style.touchAction = this.isWhole ? "pan-y" : "none";
      const density = devicePixelRatio || 1;
      canvas.width = Math.round(width * density);
      canvas.height = Math.round(height * density);
      context.scale(canvas.width / width, canvas.height / height);
      context.imageSmoothingEnabled = this.scale < 4;
      const box = [this.left, this.top, this.width * this.scale, this.height * this.scale];
      if (this.image) context.drawImage(this.image, ...box);
      const here = marks.filter((mark) => mark.photo === this.photo);
      this.drawExpected(expected(current, this.photo));
      here.forEach((mark) => this.drawMark(mark));
      this.describe(here);
    }

    // A ring where the current point should be, or the lines that it is on.
    drawExpected(should) {
      if (!should) return;
      const { context } = this;
      context.save();
      context.setLineDash([6, 4]);
      context.beginPath();
      if (should.place) {
        const { x, y } = this.onCanvas(should.place);
        context.arc(x, y, 12, 0, 2 * Math.PI);
      }
      for (const places of should.lines) {
        places.forEach(([x, y], at) => {
          const end = this.onCanvas({ x, y });
          if (at) context.lineTo(end.x, end.y);
          else context.moveTo(end.x, end.y);
        });
      }
      for (const [color, width] of [["#000000", 4], [EXPECTED_COLOR, 2]]) {
        Object.assign(context, { strokeStyle: color, lineWidth: width });
        context.stroke();
      }
      context.restore();
    }

    drawMark({ point, x, y }) {
      const { context } = this;
      const { x: atX, y: atY } = this.onCanvas({ x, y });
      context.font = "bold 14px sans-serif";
      context.beginPath();
      for (const [dx, dy] of Object.values(ARROWS)) {
        context.moveTo(atX + 3 * dx, atY + 3 * dy);
        context.lineTo(atX + 12 * dx, atY + 12 * dy);
      }
      if (point === current) {
        context.moveTo(atX + 16, atY);
        context.arc(atX, atY, 16, 0, 2 * Math.PI);
      }
      const color = point === current ? CURRENT_COLOR : COLOR;
      Object.assign(context, { lineWidth: 4, strokeStyle: "#000000", fillStyle: color });
      context.stroke();
      context.strokeText(point, atX + 14, atY - 10);
      Object.assign(context, { lineWidth: 1.5, strokeStyle: color });
      context.stroke();
      context.fillText(point, atX + 14, atY - 10);
    }

    describe(here) {
      const mark = markOf(current, this.photo);
      const isTied = ({ point }) => marks.filter((other) => other.point === point).length > 2;
      const size = this.width / this.image?.width;
      this.readout.textContent = [
        `Point ${current}: ${mark ? `x ${mark.x.toFixed(2)}, y ${mark.y.toFixed(2)}` : "no mark here"}${this.hint(mark)}.`,
        here.length ? `Points marked here: ${here.length}, ${here.filter(isTied).length} of them in two other photographs, too.` : "",
        size > 1.01 ? `Open the original to mark precisely: 1 px here is ${size.toFixed(1)} px of it.` : "",
        this.image ? "" : "No picture: open the original.",
      ].join(" ");
    }

    hint(mark) {
      const should = expected(current, this.photo);
      if (mark || !should) return "";
      return should.place ? ", it should be in the ring" : ", it should be on the line";
    }

    listen() {
      const { canvas, pointers } = this;
      const at = (event) => {
        const box = canvas.getBoundingClientRect();
        return { x: event.clientX - box.left, y: event.clientY - box.top };
      };
      canvas.addEventListener("pointerdown", (event) => {
        if (event.button) return;
        if (!pointers.size) this.dragged = 0;
        pointers.set(event.pointerId, at(event));
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointermove", (event) => {
        const [known, now] = [pointers.get(event.pointerId), at(event)];
        if (!known) return;
        const [one, two] = pointers.values();
        const before = two && distance(one, two);
        pointers.set(event.pointerId, now);
        this.dragged += distance(now, known);
        if (this.dragged < DRAG_PX) return;
        if (two) {
          const factor = distance(...pointers.values()) / Math.max(before, 1);
          this.zoom(factor, { x: (one.x + two.x) / 2, y: (one.y + two.y) / 2 });
        }
        this.pan((now.x - known.x) / pointers.size, (now.y - known.y) / pointers.size);
      });
      canvas.addEventListener("pointerup", (event) => {
        if (pointers.size > 1) this.dragged = DRAG_PX;
        else if (pointers.size && this.dragged < DRAG_PX) this.mark(at(event));
      });
      canvas.addEventListener("lostpointercapture", (event) => pointers.delete(event.pointerId));
      canvas.addEventListener("wheel", (event) => {
        if (!section.contains(document.activeElement) && !event.ctrlKey) return;
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 400), at(event));
      });
      canvas.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        const step = (ARROWS[event.key] ?? []).map((px) => (event.shiftKey ? 10 * px : px));
        const action = step.length ? () => this.move(...step) : this.actions[event.key];
        if (!action) return;
        event.preventDefault();
        action();
      });
    }
  }

  // The table: a click on a row shows its mark.
  function goTo(mark) {
    const pane = panes.find((one) => one.photo === mark.photo) ?? panes[1];
    if (pane.photo !== mark.photo) pane.load(mark.photo);
    choose(mark.point);
    pane.look(mark);
    pane.canvas.focus();
  }

  function row(mark) {
    const made = part("row").content.firstElementChild.cloneNode(true);
    const [name, point, x, y, error, gone] = made.cells;
    name.textContent = label(mark.photo);
    point.firstChild.textContent = mark.point;
    x.textContent = mark.x.toFixed(2);
    y.textContent = mark.y.toFixed(2);
    error.textContent = (mark.error ?? residual(mark))?.toFixed(1) ?? "-";
    gone.firstChild.setAttribute("aria-label", `Delete point ${mark.point} in ${name.textContent}`);
    made.classList.toggle("current", mark.point === current);
    made.addEventListener("click", (event) => (gone.contains(event.target) ? remove : goTo)(mark));
    return made;
  }

  function show() {
    const known = points();
    const option = (name) => new Option(known.includes(name) ? name : `${name} (new)`, name);
    part("point").replaceChildren(...[...new Set([...known, current, unused()])].map(option));
    part("point").value = current;
    part("rows").replaceChildren(...ordered().map(row));
    part("table").hidden = part("save").disabled = !marks.length;
    part("undo").disabled = !past.length;
    part("saved").hidden = true;
    panes.forEach((pane) => pane.draw());
    page.tiePoints?.whenChanged?.();
  }

  // Files
  const quoted = (text) => (/[",]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const cellsOf = (line) =>
    [...line.matchAll(/(?:^|,)\s*(?:"((?:[^"]|"")*)"\s*|([^,]*))/g)].map(
      ([, inQuotes, plain]) => inQuotes?.replaceAll('""', '"') ?? plain.trim());

  function save() {
    const rows = ordered().map(({ point, photo, x, y }) =>
      [quoted(point), quoted(photographs[photo][0]), x.toFixed(2), y.toFixed(2)]);
    const text = [COLUMNS, ...rows].map((cells) => `${cells.join()}\n`).join("");
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
    link.download = FILE_NAME;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
    isSaved = true;
    part("saved").hidden = false;
    say(`Marks in ${FILE_NAME}: ${marks.length}.`);
  }

  async function readTable([file]) {
    const [first, ...lines] = (await file.text()).split(/\r?\n/);
    const header = cellsOf(first.toLowerCase());
    const columns = COLUMNS.map((name) => header.indexOf(name));
    if (columns.includes(-1)) return say(`${file.name}: its first line must be ${COLUMNS}.`);
    const found = new Map();
    for (const [index, line] of lines.entries()) {
      if (!line.trim()) continue;
      const cells = cellsOf(line);
      const [point, name, ...numbers] = columns.map((column) => cells[column] ?? "");
      const photo = usable.find((other) => photographs[other][0] === name);
      const [x, y] = numbers.map((text) => (text ? Number(text) : NaN));
      const where = `${file.name}, line ${index + 2}`;
      if (photo === undefined) return say(`${where}: no such photograph, ${name}.`);
      if (!point || !Number.isFinite(x + y)) return say(`${where}: must have a point, x and y.`);
      found.set(JSON.stringify([point, photo]), { point, photo, x, y });
    }
    change([...found.values()], `Marks read from ${file.name}: ${found.size}.`);
    return choose(unused());
  }

  function readOriginals(files) {
    originals = [...files];
    say(`Originals found: ${usable.filter(original).length} of ${usable.length}.`);
    panes.forEach((pane) => pane.load(pane.photo));
  }

  const readers = { originals: readOriginals, folder: readOriginals, table: readTable };
  for (const [name, use] of Object.entries(readers)) {
    const input = part(`${name}-input`);
    part(`open-${name}`).addEventListener("click", () => input.click());
    input.addEventListener("change", async () => {
      if (input.files.length) await use(input.files);
      input.value = "";
    });
  }
  part("point").addEventListener("change", (event) => choose(event.target.value));
  Object.entries({ next, undo, save }).forEach(([name, use]) => part(name).addEventListener("click", use));
  section.addEventListener("keydown", (event) => {
    if (event.key !== "z" || !(event.ctrlKey || event.metaKey)) return;
    event.preventDefault();
    undo();
  });
  addEventListener("beforeunload", (event) => {
    if (!isSaved && !isKept) event.preventDefault();
  });

  // First a photograph that is not in the largest model, beside one that is: what it matches best.
  const isPlaced = (photo) => looks.get(photo)?.model === 0;
  const lost = usable.find(isLost) ?? usable.find((photo) => !isPlaced(photo)) ?? usable[0];
  const others = usable.filter((photo) => photo !== lost);
  const nearest = data.neighbours[lost].map(([photo]) => photo).filter((photo) => others.includes(photo));
  const shown = [lost, [...nearest, ...others].find(isPlaced) ?? others[0]];
  const panes = [];
  section.querySelectorAll("figure").forEach((figure, index) => panes.push(new Pane(figure, shown[index])));
  const before = kept();
  if (before) {
    past.push([marks, current]);
    ({ marks, current } = before);
    isSaved = false;
    say(`Marks from before: ${marks.length}. Undo goes back to those of the run.`);
  }
  show();
  // For other scripts: where the current point should be; for a server that maps again: marks as it
  // takes them, and the residuals that it returns.
  page.tiePoints = {
    current: () => current,
    isMarked: (photo) => Boolean(markOf(current, photo)),
    expected: (photo) => expected(current, photo),
    goTo(photo) {
      panes[1].load(photo);
      panes[1].seek();
      panes[1].canvas.scrollIntoView({ block: "nearest" });
      panes[1].canvas.focus({ preventScroll: true });
    },
    rows: () => ordered().map(({ point, photo, x, y }) => [point, photographs[photo][0], x, y]),
    take(residuals) {
      const errors = new Map(residuals.map(([point, name, px]) => [JSON.stringify([point, name]), px]));
      marks = marks.map((mark) =>
        ({ ...mark, error: errors.get(JSON.stringify([mark.point, photographs[mark.photo][0]])) }));
      keep();
      show();
    },
  };
  page.markIn = (one, two) => {
    section.querySelector("details").open = true;
    [one, two].forEach((photo, side) => photographs[photo] && panes[side].load(photo));
    section.scrollIntoView();
  };
})();
