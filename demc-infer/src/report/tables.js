// The table of means, and the sortable table of all images and methods.
{
  const arrowOf = { lower: "lower is better", higher: "higher is better", zero: "best near zero" };
  const head = (metric) => make("th", { scope: "col", title: metric.definition }, metric.name, make("span", { class: "better", text: arrowOf[metric.better] }));
  const cell = (value, best) => make("td", { class: !isValue(value) ? "none" : best ? "best" : "", text: number(value) });

  // Means: one row per method.
  const best = new Map(data.metrics.map((metric) => {
    const values = data.methods.map((name) => data.mean[name][metric.name]).filter(isValue);
    return [metric.name, Math.min(...values.map((value) => cost(metric, value)))];
  }));
  byId("means").append(
    make("thead", {}, make("tr", {}, make("th", { scope: "col", text: "method" }), ...data.metrics.map(head))),
    make("tbody", {}, ...data.methods.map((name) => make("tr", { class: name === "denoised" ? "ours" : "" },
      make("th", { scope: "row" }, swatch(name), name),
      ...data.metrics.map((metric) => {
        const value = data.mean[name][metric.name];
        return cell(value, isValue(value) && cost(metric, value) === best.get(metric.name));
      })))));
  const residuals = data.images.map((image) => image.residual).filter(isValue);
  if (residuals.length) {
    const mean = residuals.reduce((a, b) => a + b) / residuals.length;
    byId("residual").textContent = `The references contain noise: their mean relmse against a noise-free image is ${number(mean)}. A score near that value has no meaning.`;
  }
  if (data.failed.length) {
    const failed = data.failed.map((image) => `${image.name} (${image.error})`).join("; ");
    byId("failed").textContent = `Not scored, and not part of the means: ${failed}.`;
  }

  // Scores per image.
  const rows = data.images.flatMap((image, i) => data.methods.map((method) => ({ image: image.name, i, method, residual: image.residual, scores: image.scores[method] })));
  const columns = [
    { name: "image", value: (row) => row.image, text: true },
    { name: "method", value: (row) => row.method, text: true },
    ...data.metrics.map((metric) => ({ name: metric.name, title: metric.definition, value: (row) => row.scores[metric.name] })),
    { name: "residual", title: "relmse of the reference against a noise-free image", value: (row) => row.residual },
  ];
  let sorted = { column: null, down: false };
  const compare = (column, down) => (a, b) => {
    const [x, y] = [column.value(a), column.value(b)];
    if (!isValue(x) || !isValue(y)) return isValue(x) - isValue(y) ? (isValue(x) ? -1 : 1) : 0;
    return (down ? -1 : 1) * (column.text ? x.localeCompare(y) : x - y);
  };
  const filter = byId("filter");
  filter.append(make("option", { value: "", text: "all methods" }), ...data.methods.map((name) => make("option", { value: JSON.stringify(name), text: name })));

  const headers = columns.map((column) => {
    const arrow = make("span", { class: "arrow", "aria-hidden": "true" });
    const button = make("button", { type: "button" }, column.name, arrow);
    const th = make("th", { scope: "col" }, button);
    if (column.title) th.title = column.title;
    button.addEventListener("click", () => {
      sorted = { column, down: sorted.column === column && !sorted.down };
      fill();
      byId("sorted").textContent = `sorted by ${column.name}, ${sorted.down ? "descending" : "ascending"}`;
    });
    return { th, arrow, column };
  });
  const body = make("tbody");
  byId("scores").append(make("thead", {}, make("tr", {}, ...headers.map(({ th }) => th))), body);

  function fill() {
    const only = filter.value && JSON.parse(filter.value);
    const shown = rows.filter((row) => !only || row.method === only);
    if (sorted.column) shown.sort(compare(sorted.column, sorted.down));
    for (const { th, arrow, column } of headers) {
      const active = column === sorted.column;
      if (active) th.setAttribute("aria-sort", sorted.down ? "descending" : "ascending");
      else th.removeAttribute("aria-sort");
      arrow.textContent = active ? (sorted.down ? "▼" : "▲") : "";
    }
    body.replaceChildren(...shown.map((row) => {
      const button = make("button", { type: "button", class: "link", text: row.image, title: "Show this image" });
      button.addEventListener("click", () => { viewer.show(row.i); byId("images").scrollIntoView(); });
      return make("tr", { class: row.method === "denoised" ? "ours" : "" }, make("th", { scope: "row" }, button),
        make("td", { class: "text" }, swatch(row.method), row.method),
        ...columns.slice(2).map((column) => cell(column.value(row))));
    }));
  }
  filter.addEventListener("change", fill);
  fill();
}
