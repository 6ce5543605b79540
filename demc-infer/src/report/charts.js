// Paired differences with their intervals, and one histogram per metric.
{
  const against = [...new Set(data.differences.map((difference) => difference.against))];
  const words = (difference) => {
    const better = cost(metricsByName.get(difference.metric), 1) > 0 ? difference.mean < 0 : difference.mean > 0;
    return difference.claimed ? (better ? "better" : "worse") : "not shown";
  };
  const change = (difference, value) => difference.scale === "ratio" ? `${value < 0 ? "" : "+"}${(100 * value).toFixed(1)} %` : number(value, true);
  function sentence(name, rows) {
    const parts = [["better", "Better than"], ["worse", "Worse than"], ["not shown", "No difference shown from"]].flatMap(([word, phrase]) => {
      const metrics = rows.filter((row) => words(row) === word).map((row) => row.metric);
      return metrics.length ? `${phrase} ${name} in ${metrics.join(", ")}.` : [];
    });
    return parts.join(" ");
  }
  // Mean and interval. Each plot has its own scale, with zero in the middle and better to the left.
  function plot(difference) {
    const sign = cost(metricsByName.get(difference.metric), 1) > 0 ? 1 : -1;
    const [a, b] = difference.interval.map((end) => sign * end), mean = sign * difference.mean;
    const reach = 1.1 * Math.max(Math.abs(a), Math.abs(b), Math.abs(mean), 1e-12);
    const x = (value) => 100 + 94 * value / reach;
    const paint = { better: "var(--good)", worse: "var(--bad)" }[words(difference)] ?? "var(--neutral)";
    return svg("svg", { viewBox: "0 0 200 22", preserveAspectRatio: "none", role: "img", "aria-label": difference.verdict },
      svg("line", { x1: 100, x2: 100, y1: 1, y2: 21, stroke: "var(--line)", "stroke-width": 1.5, "vector-effect": "non-scaling-stroke" }),
      svg("line", { x1: x(Math.min(a, b)), x2: x(Math.max(a, b)), y1: 11, y2: 11, stroke: paint, "stroke-width": 3, "vector-effect": "non-scaling-stroke" }),
      svg("line", { x1: x(mean), x2: x(mean), y1: 5, y2: 17, stroke: paint, "stroke-width": 3, "vector-effect": "non-scaling-stroke" }));
  }
  for (const name of against) {
    const rows = data.differences.filter((difference) => difference.against === name);
    const head = ["metric", "change", "95 % interval", "better ← → worse", "result"].map((text, i) => make("th", { scope: "col", text, ...(i > 2 ? { style: i === 3 ? "text-align:center" : "text-align:left" } : {}) }));
    byId("difference-tables").append(make("div", {}, make("h3", { text: `denoised against ${name}, ${rows[0].images} images of ${rows[0].bases} base scenes` }),
      make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": `differences from ${name}` }, make("table", {}, make("thead", {}, make("tr", {}, ...head)),
        make("tbody", {}, ...rows.map((difference) => make("tr", { title: difference.verdict },
          make("th", { scope: "row", text: difference.metric === "energy-bias" ? "|energy-bias|" : difference.metric }),
          make("td", { text: change(difference, difference.mean) }),
          make("td", { text: difference.interval.map((end) => change(difference, end)).join(" to ") }),
          make("td", { class: "plot" }, plot(difference)),
          make("td", { class: { better: "better-word", worse: "worse-word" }[words(difference)] ?? "none", text: words(difference) })))))),
      make("p", { class: "note", text: sentence(name, rows) })));
  }
  if (!against.length) byId("differences").hidden = true;
  if (data.differences.some((difference) => difference.bases < data.fewestBases)) byId("few").textContent = `Fewer than ${data.fewestBases} base scenes cannot show a difference.`;

  // Histograms: one row per method on a common axis.
  const BINS = 22, WIDTH = 260, ROW = 24, LEFT = 58;
  function histogram(metric) {
    const methods = data.methods.filter((name) => name !== "black");
    const values = new Map(methods.map((name) => [name, data.images.map((image) => image.scores[name][metric.name]).filter(isValue)]));
    const all = [...values.values()].flat();
    if (!all.length) return null;
    const log = metric.better === "lower" && all.every((value) => value > 0) && Math.max(...all) / Math.min(...all) > 20;
    const to = log ? Math.log10 : (value) => value;
    let [low, high] = [Math.min(...all), Math.max(...all)].map(to);
    if (high - low < 1e-9) { low -= 0.5; high += 0.5; }
    const x = (value) => LEFT + 1 + (WIDTH - LEFT - 2) * (to(value) - low) / (high - low);
    const counts = new Map([...values].map(([name, list]) => {
      const bins = new Array(BINS).fill(0);
      for (const value of list) bins[Math.min(BINS - 1, Math.floor(BINS * (to(value) - low) / (high - low)))]++;
      return [name, bins];
    }));
    const most = Math.max(...[...counts.values()].flat());
    const height = methods.length * ROW + 16;
    const picture = svg("svg", { viewBox: `0 0 ${WIDTH} ${height}`, role: "img", "aria-label": `${metric.name}: ${methods.map((name) => `${name} mean ${number(data.mean[name][metric.name])}`).join(", ")}` });
    methods.forEach((name, row) => {
      const base = (row + 1) * ROW;
      picture.append(svg("line", { x1: LEFT, x2: WIDTH, y1: base, y2: base, stroke: "var(--line)" }));
      counts.get(name).forEach((count, bin) => {
        if (!count) return;
        const tall = count / most * (ROW - 9);
        const bar = svg("rect", { x: (LEFT + bin * (WIDTH - LEFT) / BINS + 0.5).toFixed(2), y: (base - tall).toFixed(2), width: ((WIDTH - LEFT) / BINS - 1).toFixed(2), height: tall.toFixed(2), fill: color(name) });
        bar.append(svg("title"));
        bar.firstChild.textContent = `${name}: ${count} of ${values.get(name).length} images`;
        picture.append(bar);
      });
      const mean = data.mean[name][metric.name];
      if (isValue(mean) && (!log || mean > 0)) picture.append(svg("line", { x1: x(mean), x2: x(mean), y1: base - ROW + 7, y2: base + 2, stroke: "var(--ink)", "stroke-width": 1.2 }));
      const text = svg("text", { x: 0, y: base - 4 });
      text.textContent = name.length > 11 ? `${name.slice(0, 10)}…` : name;
      picture.append(text);
    });
    for (const [place, anchor, value] of [[LEFT, "start", low], [WIDTH, "end", high]]) {
      const text = svg("text", { x: place, y: height - 3, "text-anchor": anchor });
      text.textContent = number(log ? 10 ** value : value);
      picture.append(text);
    }
    const note = `${metric.better === "zero" ? "best at 0" : metric.better === "higher" ? "better →" : "← better"}${log ? ", log" : ""}`;
    return make("div", { class: "histogram" }, make("h3", {}, metric.name, make("span", { text: note })), picture);
  }
  byId("histograms").append(...data.metrics.map(histogram).filter(Boolean));
}
