// node validate.js FILE.glb...: what the glTF validator says of files, as JSON; the exit status is 1 if it finds faults.
"use strict";
const fs = require("fs"), { validateBytes } = require("gltf-validator");

(async () => {
    for (const path of process.argv.slice(2)) {
        const { issues } = await validateBytes(new Uint8Array(fs.readFileSync(path)));
        console.log(path, JSON.stringify(issues));
        if (issues.numErrors + issues.numWarnings) process.exitCode = 1;
    }
})();
