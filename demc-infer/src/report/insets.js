// The worst and the median patch of the image that is shown, in every layer, pixel by pixel.
{
  let of = -1, canvases = [];
  const build = () => {
    canvases = [];
    const rows = viewer.patches().map((patch) => {
      const title = make("h3", { text: patch.kind === "worst" ? "Worst patch " : "Median patch " },
        make("span", { text: `${patch.width} × ${patch.height} pixels at ${patch.x}, ${patch.y}, by the error of the denoised image: relmse ${number(patch.relmse)}` }));
      const row = make("div", { class: "row" });
      for (const layer of viewer.layers) {
        const canvas = make("canvas", { role: "img", "aria-label": `${patch.kind} patch, ${viewer.label(layer)}`, width: patch.width, height: patch.height });
        canvases.push([canvas, layer, patch]);
        row.append(make("figure", {}, canvas, make("figcaption", { text: viewer.label(layer), title: viewer.label(layer) })));
      }
      return make("div", {}, title, row);
    });
    byId("insets").replaceChildren(...rows);
  };
  viewer.onDraw(() => {
    if (of !== viewer.image()) { of = viewer.image(); build(); }
    for (const [canvas, layer, patch] of canvases) viewer.paintLayer(canvas, layer, patch);
  });
  viewer.show(0);
}
