// The page as a file: shows the data that the document holds.

import { inflate } from "./data.js";
import { show } from "./main.js";

async function start() {
  const [data, shaders] = ["data", "shaders"].map((id) => document.getElementById(id)), text = data.textContent;
  data.remove();
  globalThis.progdf = await show(document.body, inflate(text), JSON.parse(shaders.textContent));
}

start();
