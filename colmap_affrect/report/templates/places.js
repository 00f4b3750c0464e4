"use strict";
// Where the current tie point should be in all other photographs of the model: a piece of each.
(() => {
  const { label, picture, tiePoints: tool, data } = page;
  const box = document.querySelector('#tie-points [data-part="places"]');
  if (!box) return;
  const [PIECE_PX, SHARE, MOST, COLOR] = [120, 0.15, 60, "#ff2fd0"];
  const [note, strip] = [box.querySelector("p"), box.querySelector(".strip")];
  const { photographs } = data.tie_points;

  const isInside = ([, wide, high], [x, y]) => Math.min(x, y) >= 0 && x <= wide && y <= high;

  // Photographs without a mark that may see the point: a place in them, or lines.
  function found() {
    const places = [];
    photographs.forEach((size, photo) => {
      if (!size || tool.isMarked(photo) || places.length >= MOST) return;
      const should = tool.expected(photo);
      const { place, lines = [] } = should ?? {};
      const isSeen = place ? isInside(size, [place.x, place.y])
        : lines.some((line) => line.some((at) => isInside(size, at)));
      if (isSeen) places.push({ photo, place, lines });
    });
    return places;
  }

  // Around the place, or all of the photograph with the lines.
  function draw(canvas, { photo, place, lines }) {
    const image = picture(photo, () => draw(canvas, { photo, place, lines }));
    if (!image) return;
    const [, wide, high] = photographs[photo];
    const [middle, pixels] = [PIECE_PX, 2 * PIECE_PX];
    const longest = Math.max(wide, high);
    const scale = pixels / (place ? SHARE * longest : longest);
    const [left, top] = place ? [middle - place.x * scale, middle - place.y * scale]
      : [middle - (wide * scale) / 2, middle - (high * scale) / 2];
    const context = canvas.getContext("2d");
    context.drawImage(image, left, top, wide * scale, high * scale);
    for (const [color, width] of [["#000000", 6], [COLOR, 3]]) {
      Object.assign(context, { strokeStyle: color, lineWidth: width });
      context.beginPath();
      if (place) context.arc(middle, middle, 18, 0, 2 * Math.PI);
      for (const line of lines) {
        line.forEach(([x, y], at) =>
          context[at ? "lineTo" : "moveTo"](left + x * scale, top + y * scale));
      }
      context.stroke();
    }
  }

  function piece(one) {
    const button = document.createElement("button");
    const canvas = document.createElement("canvas");
    const name = Object.assign(document.createElement("span"), { textContent: label(one.photo), className: "name" });
    Object.assign(button, { type: "button", className: "chip", title: data.names[one.photo] });
    canvas.width = canvas.height = 2 * PIECE_PX;
    button.append(canvas, name);
    button.addEventListener("click", () => tool.goTo(one.photo));
    draw(canvas, one);
    return button;
  }

  function show() {
    const places = found();
    box.hidden = !places.length;
    note.textContent = `Point ${tool.current()} in the other photographs of the model${places.length === MOST ? ", the first of them" : ""}: a click goes there.`;
    strip.replaceChildren(...places.map(piece));
  }
  tool.whenChanged = show;
  show();
})();
