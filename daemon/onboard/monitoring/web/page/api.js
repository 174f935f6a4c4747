// The API's routes, read from the OpenAPI document this service serves.

import { fetchJson } from "./http.js";

const container = document.getElementById("routes");
const api = await (await fetch("openapi.json")).json();

function element(name, properties = {}, ...children) {
  const created = Object.assign(document.createElement(name), properties);
  created.append(...children);
  return created;
}

// The type, bounds, default and description of a schema.
function schemaText(schema) {
  if (schema.$ref) return schemaText(api.components.schemas[schema.$ref.split("/").at(-1)]);
  const item = schema.anyOf ? schema.anyOf.find((other) => other.type !== "null") : schema;
  const bounds = [["minimum", "≥"], ["exclusiveMinimum", ">"], ["maximum", "≤"], ["exclusiveMaximum", "<"]]
    .filter(([key]) => item[key] != null).map(([key, sign]) => `${sign} ${item[key]}`);
  const chosen = item.enum ? [item.enum.join(" | ")] : [item.type, ...bounds];
  const usual = schema.default == null || schema.default === "" ? [] : [`${schema.default} if omitted`];
  return [...chosen, ...usual].join(", ") + (schema.description ? `; ${schema.description}` : "");
}

function fields(schema) {
  const found = schema.anyOf?.find((item) => item.$ref) || schema;
  const object = found.$ref ? api.components.schemas[found.$ref.split("/").at(-1)] : found;
  return Object.entries(object.properties || {}).map(([name, item]) => element("li", {},
    element("code", { textContent: name }), ` in the body: ${schemaText(item)}`));
}

document.getElementById("simulated").hidden = !(await fetchJson("api/v1/brief"))?.simulated;

const sections = [];
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, route] of Object.entries(methods)) {
    const parameters = (route.parameters || []).map((item) => element("li", {},
      element("code", { textContent: item.name }), ` in ${item.in}${item.required ? ", required" : ""}: `,
      schemaText({ ...item.schema, description: item.schema.description || item.description })));
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
  element("p", { textContent: "Telemetry, form=json or form=msgpack; bytes_per_s limits the rate. See docs/reference/flight/telemetry.md." })));
container.replaceChildren(...sections);
