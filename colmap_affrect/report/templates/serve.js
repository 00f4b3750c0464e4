"use strict";
// A page that colmap-affrect serves: what is drawn on it is mapped at a click.
(() => {
  const [WAIT_MS, LOST] = [400, "The server does not answer: is the command colmap-affrect serve still running?"];
  const make = (tag, text = "", more = {}) =>
    Object.assign(document.createElement(tag), { textContent: text, ...more });
  const box = make("section", "", { id: "map-again", className: "box" });
  const [head, said, found] = [make("h2", "Map again"), make("p"), make("div")];
  const button = make("button", "Map with these marks and masks", { type: "button" });
  const reload = make("button", "Show the new page", { type: "button", hidden: true });
  const bar = make("div", "", { className: "buttons" });
  said.className = "readout";
  said.setAttribute("role", "status");
  bar.append(button, reload);
  box.append(head, bar, said, found);
  const tools = document.getElementById("tie-points") ?? document.querySelector("main");
  tools.before(box);
  reload.addEventListener("click", () => location.reload());
  if (!page.tiePoints || !page.masks) {
    button.disabled = true;
    said.textContent = "This page has no tools for tie points and masks: map again with the command, then load it anew.";
    return;
  }

  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  async function ask(what, content) {
    const how = content ? { method: "POST", body: JSON.stringify(content) } : {};
    const answer = await fetch(what, { headers: { "Content-Type": "application/json" }, ...how });
    return answer.json();
  }

  async function follow() {
    button.disabled = true;
    for (;;) {
      const state = await ask("state");
      if (!state.running) return state.answer;
      said.textContent = `Mapping for ${state.seconds.toFixed(0)} s. ${state.text}`;
      await wait(WAIT_MS);
    }
  }

  function table(titles, rows) {
    const made = make("table");
    const head = make("tr");
    head.append(...titles.map((title) => make("th", title, { scope: "col" })));
    made.append(head, ...rows.map((cells) => {
      const row = make("tr");
      row.append(...cells.map((cell) => make("td", cell)));
      return row;
    }));
    const scrolled = make("div", "", { className: "scroll", tabIndex: 0 });
    scrolled.append(made);
    return scrolled;
  }

  function show(answer) {
    if (!answer) return;
    if (answer.error) {
      said.textContent = answer.error;
      return;
    }
    const changed = answer.changes.length;
    said.textContent = [
      answer.why ? `${answer.why}.` : "Mapped.",
      changed ? `Photographs that changed: ${changed}.` : "No photograph changed its class.",
      answer.residuals.length ? `Residuals of marks: ${answer.residuals.length}, the largest ${Math.max(...answer.residuals.map(([, , px]) => px)).toFixed(1)} px.` : "",
    ].join(" ");
    found.replaceChildren(table(["", "before", "now"], answer.figures));
    if (changed) found.append(table(["Photograph", "before", "now"], answer.changes));
    page.tiePoints.take(answer.residuals);
    reload.hidden = false;
  }

  async function run(begin) {
    try {
      const refused = await begin();
      if (refused?.error) said.textContent = refused.error;
      else show(await follow());
    } catch {
      said.textContent = LOST;
    }
    button.disabled = false;
  }

  button.addEventListener("click", () => run(async () => {
    [said.textContent, reload.hidden] = ["Sending.", true];
    found.replaceChildren();
    return ask("map", { marks: page.tiePoints.rows(), masks: await page.masks.pictures() });
  }));

  // A mapping that was begun before the page was loaded again.
  run(async () => null);
})();
