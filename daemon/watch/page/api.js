// The API's routes, read from the OpenAPI document this service serves.

import { askedJson } from "./asking.js";

const room = document.getElementById("routes");
const api = await (await fetch("openapi.json")).json();

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

document.getElementById("simulated").hidden = !(await askedJson("api/v1/brief"))?.simulated;

const sections = [];
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, route] of Object.entries(methods)) {
    const parameters = (route.parameters || []).map((one) => element("li", {},
      element("code", { textContent: one.name }), ` in ${one.in}${one.required ? ", needed" : ""}: `,
      element("code", { textContent: JSON.stringify(one.schema) })));
    const body = route.requestBody?.content?.["application/json"]?.schema;
    sections.push(element("section", {},
      element("h2", {}, element("span", { className: "method", textContent: method.toUpperCase() }),
        element("code", { textContent: path })),
      element("p", { textContent: route.description || "" }),
      element("ul", {}, ...parameters),
      ...(body ? [element("pre", { textContent: JSON.stringify(body) })] : [])));
  }
}
sections.push(element("section", {},
  element("h2", {}, element("span", { className: "method", textContent: "WS" }),
    element("code", { textContent: "/api/v1/telemetry" })),
  element("p", { textContent: "Telemetry, form=json or form=msgpack, bytes_per_s limits it; docs/telemetry.md." })));
room.replaceChildren(...sections);
