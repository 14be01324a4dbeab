// Keys, and the box that finds a robot, a panel or an act by what one types.

const PANELS = ["map", "values", "pace", "error", "robots", "events", "control"];
const HELP = [
  ["1 to 9", "a robot"], ["Esc", "lets the robot go"], ["space", "play or pause"], ["← →", "a second back or on"], ["End", "back to the present"],
  ["Ctrl K", "find or do"], ["L", "layout"], ["R", "runs"], ["D", "light or dark"], ["Shift Esc", "STOP, with --control"], ["?", "these keys"],
];

export class Finder {
  constructor(dialog, parts) {
    Object.assign(this, { dialog, ...parts });
    [this.input, this.list] = [dialog.querySelector("input"), dialog.querySelector("ul")];
    this.index = 0;
    this.input.addEventListener("input", () => this.fill(0));
    this.input.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (step) this.fill(this.index + step);
      else if (event.key === "Enter") this.found[this.index]?.act();
      else return;
      event.preventDefault();
    });
    document.querySelector("#find").addEventListener("click", () => this.open());
    document.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    const typing = event.target.closest?.("input:not([type=range], [type=checkbox]), select, textarea"), time = this.time();
    if (event.key === "Escape" && event.shiftKey) this.controls.stop.hidden || this.controls.stop.click();
    else if (event.key === "k" && (event.ctrlKey || event.metaKey)) this.open();
    else if (event.key === "Escape") document.querySelector("dialog[open]") ? document.querySelector("dialog[open]").close() : window.swarmView.selected && this.select(window.swarmView.selected);
    else if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    else if (event.target.closest?.("#map canvas") && event.key.startsWith("Arrow")) return;
    else if (/^[1-9]$/.test(event.key) && this.store.names[event.key - 1]) this.select(this.store.names[event.key - 1]);
    else if (event.key === " " && !event.target.closest?.("button, a, tr")) time.toggle();
    else if ((event.key === "ArrowLeft" || event.key === "ArrowRight") && !event.target.closest?.(".scroll")) time.go((time.wanted ?? this.store.t) + (event.key === "ArrowLeft" ? -1 : 1));
    else if (event.key === "End" && !this.store.swarm?.recording && !event.target.closest?.(".scroll")) time.go(null);
    else if (event.key === "l") this.layout.arrange();
    else if (event.key === "r") this.runs.toggle();
    else if (event.key === "d") this.toggleTheme();
    else if (event.key === "?") this.open("?");
    else return;
    event.preventDefault();
  }

  open(text = "") {
    this.input.value = text;
    this.dialog.open || this.dialog.show();
    this.input.focus();
    this.fill(0);
  }

  all() {
    const done = (act) => () => {
      this.dialog.close();
      act();
    };
    return [
      ...this.store.names.map((name) => ({ text: `robot ${name}`, act: done(() => this.select(name)) })),
      ...PANELS.filter((name) => !document.querySelector(`[data-panel=${name}].panel`).hidden).map((name) => ({ text: `panel ${name}`, act: done(() => this.answers.go(name)) })),
      ...[...document.querySelectorAll("#stop, #control button, #virtual button")].filter((each) => each.offsetParent).map((each) => ({ text: each.ariaLabel ?? each.textContent, act: done(() => each.click()) })),
      { text: "light or dark", act: done(() => this.toggleTheme()) },
      { text: "arrange panels", act: done(() => this.layout.arrange()) },
    ];
  }

  fill(index) {
    const words = this.input.value.toLowerCase().split(/\s+/).filter(Boolean);
    this.found = words[0] === "?" ? HELP.map(([key, what]) => ({ text: `${key}: ${what}`, act: () => {} })) : this.all().filter(({ text }) => words.every((word) => text.toLowerCase().includes(word)));
    this.index = Math.min(this.found.length - 1, Math.max(0, index));
    this.list.replaceChildren(...this.found.slice(0, 40).map(({ text, act }, at) => {
      const item = document.createElement("li");
      [item.textContent, item.id, item.role, item.ariaSelected] = [text, `found-${at}`, "option", String(at === this.index)];
      item.addEventListener("click", act);
      return item;
    }));
    this.input.setAttribute("aria-activedescendant", this.found.length ? `found-${this.index}` : "");
    this.list.children[this.index]?.scrollIntoView({ block: "nearest" });
  }
}
