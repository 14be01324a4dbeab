// Which panels are shown, in which order and how large. The page has its own layout by what there is; others have names and
// are kept by the server, since the page's address is another one after each start.

const SPANS = { map: [2, 2], values: [2, 2], pace: [2, 1], error: [2, 1], robots: [4, 2], events: [2, 2], control: [2, 2], runs: [1, 4], difference: [2, 2] };
const OWN = "by kind of app";

export class Layout {
  constructor(main, choice, dialog, store, ask) {
    Object.assign(this, { main, choice, dialog, store, ask });
    choice.addEventListener("change", () => {
      if (choice.value === "+") this.arrange();
      else this.ask({ layout: { name: choice.value } });
      this.told = null;
    });
  }

  draw() {
    const kept = this.store.layouts ?? { current: "", layouts: {} }, told = JSON.stringify([kept, this.store.swarm?.acts?.length > 0, Boolean(this.store.swarm?.recording)]);
    if (told === this.told) return;
    this.told = told;
    this.choice.replaceChildren(new Option(OWN, ""), ...Object.keys(kept.layouts).map((name) => new Option(name, name)), new Option("arrange ...", "+"));
    this.choice.value = kept.current;
    this.apply(kept.layouts[kept.current] ?? null);
  }

  // Panels as [[name, columns, rows], ...]; null: the page's own.
  apply(panels) {
    this.main.classList.toggle("arranged", Boolean(panels));
    for (const panel of this.main.querySelectorAll(".panel")) {
      const index = panels?.findIndex(([name]) => name === panel.dataset.panel) ?? -1;
      panel.classList.toggle("away", Boolean(panels) && index < 0 && panel.dataset.panel !== "keys");
      panel.style.order = index < 0 ? (panels ? 99 : "") : index;
      panel.style.gridColumn = index < 0 ? "" : `span ${panels[index][1]}`;
      panel.style.gridRow = index < 0 ? "" : `span ${panels[index][2]}`;
    }
  }

  get names() {
    return [...this.main.querySelectorAll(".panel")].map((panel) => panel.dataset.panel).filter((name) => name !== "keys");
  }

  // The dialog: which panels, how wide and high, in which order, under which name.
  arrange() {
    const kept = this.store.layouts ?? { current: "", layouts: {} }, before = kept.layouts[kept.current];
    const shown = before ?? this.names.filter((name) => !["runs", "difference", "control"].includes(name) || !this.main.querySelector(`[data-panel=${name}]`).hidden).map((name) => [name, ...SPANS[name]]);
    let panels = [...shown.map(([name, ...spans]) => ({ name, spans, on: true })), ...this.names.filter((name) => !shown.some(([each]) => each === name)).map((name) => ({ name, spans: SPANS[name], on: false }))];
    const chosen = () => panels.filter(({ on }) => on).map(({ name, spans }) => [name, ...spans]);
    const form = document.createElement("form"), head = document.createElement("div"), rows = document.createElement("div"), end = document.createElement("div"), name = document.createElement("input");
    const button = (text, act, label) => Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick: act, ariaLabel: label ?? text });
    const draw = () => {
      rows.replaceChildren(...panels.map((panel, index) => {
        const row = document.createElement("div"), on = Object.assign(document.createElement("input"), { type: "checkbox", checked: panel.on, ariaLabel: `show ${panel.name}` }), title = document.createElement("span");
        title.textContent = this.main.querySelector(`[data-panel=${panel.name}]`).ariaLabel;
        on.onchange = () => {
          panel.on = on.checked;
          this.apply(chosen());
        };
        const spans = [["columns", 6], ["rows", 4]].map(([what, most], axis) => Object.assign(document.createElement("input"), { type: "number", min: 1, max: most, value: panel.spans[axis], ariaLabel: `${what} of ${panel.name}`, onchange: ({ target }) => {
          panel.spans = panel.spans.map((each, other) => (other === axis ? Math.min(most, Math.max(1, Math.round(Number(target.value)) || 1)) : each));
          this.apply(chosen());
        } }));
        const up = button("↑", () => {
          if (index) panels.splice(index - 1, 0, panels.splice(index, 1)[0]);
          this.apply(chosen());
          draw();
          rows.querySelectorAll("button")[Math.max(0, index - 1)].focus();
        }, `${panel.name} earlier`);
        row.className = "row";
        row.append(on, title, ...spans, up);
        return row;
      }));
    };
    name.value = kept.current;
    [name.placeholder, name.ariaLabel, name.required, name.maxLength] = ["name of the layout", "name of the layout", true, 40];
    end.className = "row";
    end.append(name, Object.assign(document.createElement("button"), { type: "submit", textContent: "keep" }));
    if (kept.current) end.append(button("forget", () => {
      this.ask({ layout: { name: kept.current, panels: null } });
      this.dialog.close();
    }));
    end.append(button("cancel", () => this.dialog.close()));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.ask({ layout: { name: name.value.trim(), panels: chosen() } });
      this.dialog.close();
    });
    this.dialog.addEventListener("close", () => (this.told = null), { once: true });
    head.className = "row muted";
    head.append(...["panel", "columns", "rows"].map((each) => Object.assign(document.createElement("span"), { textContent: each })));
    form.append(head, rows, end);
    this.dialog.replaceChildren(form);
    draw();
    this.dialog.show();
  }
}
