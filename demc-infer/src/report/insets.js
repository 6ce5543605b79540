// The worst and the median patch of the image that is shown, in every layer, pixel by pixel.
{
  let of = -1, canvases = [];
  const build = () => {
    canvases = [];
    const rows = viewer.patches().map((patch) => {
      const title = make("h3", { text: patch.kind === "worst" ? "Worst patch " : "Median patch " },
        make("span", { text: `${patch.width} × ${patch.height} pixels at ${patch.x}, ${patch.y}; relmse of denoised ${number(patch.relmse)}` }));
      // Errors stand under their pictures.
      const row = make("div", { class: "row" });
      const pictures = viewer.layers.filter((layer) => !layer.startsWith("error:"));
      row.style.setProperty("--count", pictures.length);
      for (const layer of [...pictures, ...pictures.map((name) => `error:${name}`).filter((layer) => viewer.layers.includes(layer))]) {
        const canvas = make("canvas", { role: "img", "aria-label": `${patch.kind} patch, ${viewer.label(layer)}`, width: patch.width, height: patch.height });
        canvases.push([canvas, layer, patch]);
        const caption = layer.startsWith("error:") ? "error" : layer;
        row.append(make("figure", {}, canvas, make("figcaption", { text: caption, title: viewer.label(layer) })));
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
