// The API's routes, read from the OpenAPI document this service serves.

import { askedJson } from "./asking.js";

const room = document.getElementById("routes");
const api = await (await fetch("openapi.json")).json();

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// A schema in words: what it is, within which bounds, what for.
function words(schema) {
  if (schema.$ref) return words(api.components.schemas[schema.$ref.split("/").at(-1)]);
  const one = schema.anyOf ? schema.anyOf.find((other) => other.type !== "null") : schema;
  const bounds = [["minimum", "≥"], ["exclusiveMinimum", ">"], ["maximum", "≤"], ["exclusiveMaximum", "<"]]
    .filter(([key]) => one[key] != null).map(([key, sign]) => `${sign} ${one[key]}`);
  const chosen = one.enum ? [one.enum.join(" | ")] : [one.type, ...bounds];
  const usual = schema.default == null || schema.default === "" ? [] : [`${schema.default} if left out`];
  return [...chosen, ...usual].join(", ") + (schema.description ? `; ${schema.description}` : "");
}

function fields(schema) {
  const found = schema.anyOf?.find((one) => one.$ref) || schema;
  const object = found.$ref ? api.components.schemas[found.$ref.split("/").at(-1)] : found;
  return Object.entries(object.properties || {}).map(([name, one]) => element("li", {},
    element("code", { textContent: name }), ` in the body: ${words(one)}`));
}

document.getElementById("simulated").hidden = !(await askedJson("api/v1/brief"))?.simulated;

const sections = [];
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, route] of Object.entries(methods)) {
    const parameters = (route.parameters || []).map((one) => element("li", {},
      element("code", { textContent: one.name }), ` in ${one.in}${one.required ? ", needed" : ""}: `,
      words({ ...one.schema, description: one.schema.description || one.description })));
    const body = route.requestBody?.content?.["application/json"]?.schema;
    sections.push(element("section", {},
      element("h2", {}, element("span", { className: "method", textContent: method.toUpperCase() }),
        element("code", { textContent: path })),
      element("p", { textContent: route.description || "" }),
      element("ul", {}, ...parameters, ...(body ? fields(body) : []))));
  }
}
sections.push(element("section", {},
  element("h2", {}, element("span", { className: "method", textContent: "WS" }),
    element("code", { textContent: "/api/v1/telemetry" })),
  element("p", { textContent: "Telemetry, form=json or form=msgpack, bytes_per_s limits it; docs/telemetry.md." })));
room.replaceChildren(...sections);
