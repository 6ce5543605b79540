// The viewer: two layers of one image, a divider, exposure. Layers are called "noisy", ... and "error:noisy", ...
const viewer = (() => {
  const stage = byId("stage"), divider = byId("divider"), exposure = byId("exposure");
  const sides = { left: byId("canvas-left"), right: byId("canvas-right") };
  const chosen = { left: "noisy", right: "denoised" };
  const names = data.methods.filter((name) => name !== "black");
  const layers = [...names, "reference", ...names.map((name) => `error:${name}`)];
  const label = (layer) => layer.startsWith("error:") ? `error of ${layer.slice(6)}` : layer;
  let image = 0, position = 50, shown = 0, pictures = null;
  const listeners = [];
  const decoded = new Map();

  // Code -> display byte at an exposure: invert the logarithmic curve, then clip and gamma.
  function exposureTable(stops) {
    const { white, toe } = data.curve;
    return Uint8ClampedArray.from({ length: 256 }, (_, code) => {
      const radiance = (Math.pow(1 + toe * white, code / 255) - 1) / toe;
      return 255 * Math.pow(Math.min(1, radiance * 2 ** stops), 1 / 2.2);
    });
  }
  // The colour map "inferno", interpolated between 9 of its colours.
  const heat = (() => {
    const stops = [[0, 0, 4], [31, 12, 72], [85, 15, 109], [136, 34, 106], [186, 54, 85], [227, 89, 51], [249, 140, 10], [249, 201, 50], [252, 255, 164]];
    return Array.from({ length: 256 }, (_, code) => {
      const place = code / 255 * (stops.length - 1), i = Math.min(Math.floor(place), stops.length - 2);
      return stops[i].map((value, c) => value + (stops[i + 1][c] - value) * (place - i));
    });
  })();
  let table = exposureTable(0);

  // The codes of a picture, decoded once while its image is selected.
  async function codes(url) {
    if (!decoded.has(url)) {
      decoded.set(url, (async () => {
        const element = new Image();
        element.src = url;
        await element.decode();
        const canvas = make("canvas", { width: element.naturalWidth, height: element.naturalHeight });
        const context = canvas.getContext("2d", { willReadFrequently: true });
        context.drawImage(element, 0, 0);
        return context.getImageData(0, 0, canvas.width, canvas.height);
      })());
    }
    return decoded.get(url);
  }

  async function paint(canvas, url, isError) {
    const source = await codes(url);
    const out = new ImageData(source.width, source.height);
    const from = source.data, to = out.data;
    for (let i = 0; i < from.length; i += 4) {
      if (isError) {
        const rgb = heat[from[i]];
        to[i] = rgb[0]; to[i + 1] = rgb[1]; to[i + 2] = rgb[2];
      } else {
        to[i] = table[from[i]]; to[i + 1] = table[from[i + 1]]; to[i + 2] = table[from[i + 2]];
      }
      to[i + 3] = 255;
    }
    if (canvas.width !== out.width || canvas.height !== out.height) Object.assign(canvas, { width: out.width, height: out.height });
    canvas.getContext("2d").putImageData(out, 0, 0);
  }
  const paintLayer = (canvas, layer, from) => layer.startsWith("error:") ? paint(canvas, from.errors[layer.slice(6)], true) : paint(canvas, from.pictures[layer], false);

  async function draw() {
    const ticket = ++shown;
    const info = data.images[image];
    const jobs = Object.entries(sides).map(([side, canvas]) => {
      const layer = chosen[side];
      canvas.setAttribute("aria-label", `${info.name}, ${label(layer)}`);
      byId(`tag-${side}`).textContent = label(layer);
      return paintLayer(canvas, layer, pictures);
    });
    await Promise.all(jobs);
    if (ticket === shown) stage.dataset.drawn = `${image} ${chosen.left} ${chosen.right} ${exposure.value}`;
    listeners.forEach((listener) => listener());
  }

  function place(percent) {
    position = Math.min(100, Math.max(0, percent));
    sides.left.style.clipPath = `inset(0 ${100 - position}% 0 0)`;
    divider.style.left = `${position}%`;
    divider.setAttribute("aria-valuenow", Math.round(position));
    divider.setAttribute("aria-valuetext", `${Math.round(position)} % ${label(chosen.left)}, then ${label(chosen.right)}`);
  }

  function fit() {
    const info = data.images[image];
    const room = byId("viewing").clientWidth;
    const height = Math.max(240, Math.min(window.innerHeight * 0.82, 800));
    // Small images are enlarged by whole factors, so that all pixels have the same size.
    const fits = Math.min(room / info.width, height / info.height);
    const scale = fits >= 2 ? Math.floor(fits) : fits;
    stage.classList.toggle("large", scale > 1);
    const width = Math.min(room, info.width * scale);
    byId("viewer").style.width = `${width}px`;
    stage.style.width = `${width}px`;
    stage.style.aspectRatio = `${info.width} / ${info.height}`;
  }

  function outline() {
    const info = data.images[image];
    byId("boxes").replaceChildren(...pictures.patches.map((patch) => {
      const box = make("div", { class: patch.y * 8 < info.height ? "box low" : "box" }, make("span", { text: patch.kind }));
      Object.assign(box.style, { left: `${100 * patch.x / info.width}%`, top: `${100 * patch.y / info.height}%`, width: `${100 * patch.width / info.width}%`, height: `${100 * patch.height / info.height}%` });
      return box;
    }));
  }

  function describe() {
    const info = data.images[image], [worst, best] = info.quality;
    byId("caption").replaceChildren(make("strong", { text: info.name }), make("div", {
      text: `${info.width} × ${info.height}, picture ${image + 1} of ${data.images.length}, JPEG quality ${worst === best ? best : `${worst} to ${best}`}`,
    }));
    byId("scale-note").textContent = info.block > 1 ? `Means of ${info.block} × ${info.block} pixels; independent of exposure.` : "One value per pixel; independent of exposure.";
  }

  function show(index) {
    image = index;
    decoded.clear();
    pictures = JSON.parse(byId(`pictures-${index}`).textContent);
    [...byId("strip").children].forEach((button, i) => button.setAttribute("aria-pressed", String(i === index)));
    fit(); outline(); describe(); place(position);
    return draw();
  }

  for (const [i, info] of data.images.entries()) {
    const canvas = make("canvas", { "aria-hidden": "true" });
    const button = make("button", { type: "button", "aria-pressed": "false", title: info.name }, canvas, make("span", { class: "name", text: info.name }), make("span", { class: "value", text: `relmse ${number(info.scores.denoised.relmse)}` }));
    button.addEventListener("click", () => show(i));
    byId("strip").append(button);
    paint(canvas, info.thumbnail, false);
  }
  byId("strip").addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const next = step && byId("strip").children[[...byId("strip").children].indexOf(document.activeElement) + step];
    if (next) { next.focus(); next.click(); event.preventDefault(); }
  });
  for (const side of ["left", "right"]) {
    const select = byId(side);
    select.append(...layers.map((layer) => make("option", { value: layer, text: label(layer) })));
    select.value = chosen[side];
    select.addEventListener("change", () => { chosen[side] = select.value; place(position); draw(); });
  }
  function expose(stops) {
    exposure.value = stops;
    const text = `${stops > 0 ? "+" : stops < 0 ? "−" : ""}${Math.abs(stops)} stops`;
    byId("exposure-value").textContent = text;
    exposure.setAttribute("aria-valuetext", text);
    table = exposureTable(Number(stops));
    draw();
  }
  exposure.addEventListener("input", () => expose(Number(exposure.value)));
  byId("exposure-reset").addEventListener("click", () => expose(0));
  divider.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -100, End: 100 }[event.key];
    if (step) { place(position + step); event.preventDefault(); }
  });
  stage.addEventListener("pointerdown", (event) => {
    const move = (pointer) => { const box = stage.getBoundingClientRect(); place(100 * (pointer.clientX - box.left) / box.width); };
    const end = () => { stage.removeEventListener("pointermove", move); };
    stage.setPointerCapture(event.pointerId);
    stage.addEventListener("pointermove", move);
    stage.addEventListener("pointerup", end, { once: true });
    stage.addEventListener("pointercancel", end, { once: true });
    move(event);
    divider.focus({ preventScroll: true });
    event.preventDefault();
  });
  window.addEventListener("resize", fit);

  const bar = byId("scale-bar").getContext("2d"), ramp = bar.createImageData(256, 1);
  heat.forEach((rgb, i) => ramp.data.set([...rgb, 255], 4 * i));
  bar.putImageData(ramp, 0, 0);
  const [low, high] = data.errorScale.map((end) => Math.round(Math.log10(end)));
  for (let power = low; power <= high; power++) {
    const tick = make("span", { text: power === low ? `≤ ${10 ** power}` : power === high ? `≥ ${10 ** power}` : String(10 ** power) });
    tick.style.left = `${100 * (power - low) / (high - low)}%`;
    byId("scale-ticks").append(tick);
  }
  return { show, layers, label, paintLayer, patches: () => pictures.patches, onDraw: (listener) => listeners.push(listener), image: () => image };
})();

// The worst and the median patch of the selected image in every layer, at full resolution.
{
  let built = -1, canvases = [];
  const build = () => {
    canvases = [];
    const rows = viewer.patches().map((patch) => {
      const title = make("h3", { text: patch.kind === "worst" ? "Worst patch " : "Median patch " },
        make("span", { text: `${patch.width} × ${patch.height} pixels at ${patch.x}, ${patch.y}; relmse of denoised ${number(patch.relmse)}` }));
      // Errors are below their pictures.
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
    if (built !== viewer.image()) { built = viewer.image(); build(); }
    for (const [canvas, layer, patch] of canvases) viewer.paintLayer(canvas, layer, patch);
  });
  viewer.show(0);
}
