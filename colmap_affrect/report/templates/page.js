"use strict";
// What all scripts of a page share: photographs, the dialog that shows one, panels, filters.
const page = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const label = (index) => `${index + 1} ${data.names[index]}`;
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const limited = (value, low, high) => Math.min(Math.max(value, low), high);
  document.documentElement.classList.add("script");

  // Photographs: each is in the page once, on the contact sheet.
  const cards = all("#sheet > li");
  const source = (index) => cards[index]?.querySelector("img")?.src ?? "";

  // A picture to draw, once it is loaded; null before, and where there is none.
  const pictures = new Map();
  function picture(index, whenLoaded) {
    const known = pictures.get(index);
    if (known) return known.complete && known.naturalWidth ? known : null;
    if (!source(index)) return null;
    const image = new Image();
    image.addEventListener("load", whenLoaded);
    image.src = source(index);
    pictures.set(index, image);
    return null;
  }
  for (const image of all("img[data-small]")) {
    image.src = source(Number(image.dataset.small));
    image.hidden = !image.src;
  }

  const dialog = document.getElementById("photo");
  const [through, marks, covers] = ["through", "mark", "mask"].map((name) => dialog.querySelector(`[data-${name}]`));
  const shares = dialog.querySelector(".shares");
  const shared = { looks: () => false, lookThrough: () => {} };
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
    const terms = (data.facts?.[opened] ?? []).flatMap(([title, text]) =>
      [["dt", title], ["dd", text]].map(([tag, words]) =>
        Object.assign(document.createElement(tag), { textContent: words })));
    dialog.querySelector(".facts").replaceChildren(...terms);
    showShares(data.neighbours?.[opened] ?? []);
    through.hidden = !shared.looks(opened);
    marks.hidden = !(shared.markIn && data.tie_points.photographs[opened]);
    covers.hidden = !(shared.masks && data.tie_points.photographs[opened]);
    if (!dialog.open) dialog.showModal();
    dialog.scrollTop = 0; // the button that has the keys may be far below the photograph
  }

  // The photographs that it shares most with; a click shows what.
  function showShares(others) {
    shares.hidden = !(others.length && shared.showPair);
    const buttons = others.map(([index, count, kind]) => {
      const button = document.createElement("button");
      const what = count === 1 ? kind.slice(0, -1) : kind;
      Object.assign(button, { type: "button", textContent: `${label(index)}: ${count} ${what}` });
      button.dataset.pair = index;
      return button;
    });
    shares.replaceChildren("Shares most with, click to see what: ", ...buttons);
  }

  dialog.addEventListener("click", (event) => {
    const other = event.target.closest("[data-pair]");
    if (other) {
      dialog.close();
      shared.showPair(opened, Number(other.dataset.pair));
      return;
    }
    if (event.target === marks || event.target === covers) {
      dialog.close();
      if (event.target === marks) shared.markIn(opened, data.neighbours[opened][0]?.[0]);
      else shared.masks.open(opened);
      return;
    }
    const step = event.target.closest("button")?.dataset.step;
    if (event.target === through) {
      dialog.close();
      shared.lookThrough(opened);
    } else if (event.target === dialog || step === "0") dialog.close();
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
  document.addEventListener("click", (event) => {
    const { tool } = event.target.closest("[data-tool]")?.dataset ?? {};
    if (tool) document.querySelector(`#${tool} details`).open = true;
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

  return Object.assign(shared, { data, all, label, bytes, limited, cards, source, picture, open });
})();
