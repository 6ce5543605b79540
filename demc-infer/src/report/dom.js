// The numbers, and helpers that build elements. Text is never set as HTML.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "text") element.textContent = value;
    else if (key in element && typeof value !== "string") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// Four digits after the point, fewer for large numbers.
function number(value, signed = false) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  const text = size >= 1e5 ? size.toExponential(2) : size.toFixed(size >= 1000 ? 1 : size >= 100 ? 2 : size >= 10 ? 3 : 4);
  return (value < 0 ? "−" : signed ? "+" : "") + text;
}

const metricsByName = new Map(data.metrics.map((metric) => [metric.name, metric]));
// The value on a scale where smaller is better.
function cost(metric, value) {
  return { lower: value, higher: -value, zero: Math.abs(value) }[metric.better];
}
const isValue = (value) => value !== null && value !== undefined;

const color = (() => {
  const others = data.methods.filter((name) => !["noisy", "black", "denoised"].includes(name));
  return (name) => ["noisy", "black", "denoised"].includes(name) ? `var(--${name})` : `var(--other-${others.indexOf(name) % 4})`;
})();
function swatch(name) {
  const element = make("span", { class: "swatch", "aria-hidden": "true" });
  element.style.background = color(name);
  return element;
}

document.title = `Denoising report: ${data.about.data}, ${data.about.split}`;
for (const [term, value] of [["Model", data.about.model], ["Data", `${data.about.data}, split ${data.about.split}`], ["Images", data.images.length]]) {
  byId("about").append(make("div", {}, make("dt", { text: term }), make("dd", { text: value })));
}
for (const metric of data.metrics) {
  byId("definitions").append(make("dt", { text: metric.name }), make("dd", { text: `${metric.definition}. Best: ${metric.better === "zero" ? "near zero" : metric.better}.` }));
}
byId("footer").textContent = `demc-infer ${data.version}`;
