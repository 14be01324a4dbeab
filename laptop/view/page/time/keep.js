// Pictures and films of the page, which the server makes with a browser of its own.

export class Keep {
  constructor(section, parts) {
    Object.assign(this, { section, ...parts });
    this.buttons = new Map([...section.querySelectorAll("button")].map((button) => [button.dataset.keep, button]));
    for (const [what, button] of this.buttons) button.addEventListener("click", () => this.make(what, button));
  }

  draw() {
    this.buttons.get("film").hidden = !this.store.swarm?.recording;
  }

  // What is shown: which recording, its instant or part, the chart that a person has chosen, light or dark.
  query(what) {
    const recording = this.store.swarm?.recording, query = new URLSearchParams({ token: new URLSearchParams(location.search).get("token"), theme: document.documentElement.dataset.theme });
    if (recording) {
      query.set("run", recording.name);
      const [from, to] = this.bracket.range;
      if (what === "film") query.set("from", from), query.set("to", to);
      else query.set("at", this.store.t);
    }
    const [source, ...others] = this.values.shown?.sources ?? [];
    if (this.values.chosen && source?.fields.length === 1 && !others.length) query.set("chart", `${source.topic}:${source.fields[0].join(".")}`);
    return query;
  }

  async make(what, button) {
    button.disabled = true;
    this.tell(`the ${what} is being made ...`, false);
    try {
      const answer = await fetch(`${what}?${this.query(what)}`);
      if (!answer.ok) return this.tell(`no ${what}: ${await answer.text()}`, true);
      const link = document.createElement("a"), name = this.store.swarm?.recording?.name ?? "swarm";
      link.href = URL.createObjectURL(await answer.blob());
      link.download = `${name}.${what === "film" ? "mp4" : "png"}`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
      this.tell(`${link.download} is made`, false);
    } catch {
      this.tell(`no ${what}: the server does not answer`, true);
    } finally {
      button.disabled = false;
    }
  }
}
