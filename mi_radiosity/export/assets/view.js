// A walk through a solved scene. The data: arrays of vertices, triangles and leaves (see page.py), and layers of
// irradiance, of which any weighted sum is shown: direct and indirect light, of all lamps or of each.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);
const canvas = document.querySelector("canvas");

// ---- Reading the arrays ---------------------------------------------------------------------------

async function unpack(packed) {
    const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const planes = new Uint8Array(await new Response(stream).arrayBuffer());
    const { size, items } = packed, count = planes.length / size;
    const values = new (size === 1 ? Uint8Array : size === 2 ? Uint16Array : Uint32Array)(count);
    for (let byte = 0; byte < size; byte++)
        for (let i = 0; i < count; i++) values[i] |= planes[byte * count + i] << (8 * byte);
    if (packed.deltas) {
        const signed = (x) => (x >>> 1) ^ -(x & 1);
        for (let i = 0; i < count; i++) values[i] = signed(values[i]) + (i < items ? 0 : values[i - items]);
    }
    return values;
}

function half(bits) { // float16
    const exponent = (bits >> 10) & 31, mantissa = bits & 1023;
    return exponent ? (1 + mantissa / 1024) * 2 ** (exponent - 15) : mantissa * 2 ** -24;
}

const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => half(bits & 32767));
const halves = (bits, scale) => Float32Array.from(bits, (b) => HALVES[b] * scale);

// ---- Geometry: no vertex is shared, so that each triangle can have its own light --------------------

async function load() {
    const names = Object.keys(data.arrays);
    const arrays = Object.fromEntries(await Promise.all(names.map(async (n) => [n, await unpack(data.arrays[n])])));
    const index = arrays.triangles, corners = index.length;
    const light = (name) => data.layers.map((layer, k) => halves(arrays[`${name}${k}`], data.light));
    const smooth = light("layer"), flat = light("leaf_layer");
    const transmits = "through0" in arrays, through = (name) => (transmits ? light(name) : []);
    const reflectance = Float32Array.from(arrays.reflectance, (x) => x / 65535), emission = halves(arrays.emission, data.light);

    const spread = (values, items, of) => {
        const result = new Float32Array(corners * items);
        for (let i = 0; i < corners; i++)
            for (let k = 0; k < items; k++) result[i * items + k] = values[of(i) * items + k];
        return result;
    };
    const vertex = (i) => index[i], leaf = (i) => arrays.leaf[(i / 3) | 0];
    const places = Float32Array.from(arrays.places, (q, i) => q * data.step + data.low[i % 3]);
    const mesh = {
        corners,
        position: spread(places, 3, vertex),
        reflectance: spread(reflectance, 3, vertex),
        emission: spread(emission, 3, vertex),
        smooth: { layers: smooth, of: vertex }, // of vertices, and of leaves
        flat: { layers: flat, of: leaf },
        // Light that comes through from the other side of faces, W/m².
        through: { smooth: { layers: through("through"), of: vertex }, flat: { layers: through("leaf_through"), of: leaf } },
        uv: arrays.uv ? spread(Float32Array.from(arrays.uv, (x) => x / 65535), 2, vertex) : new Float32Array(2 * corners),
        inner: new Float32Array(3 * corners), // 1 for the sides of a triangle within its leaf
    };
    for (let i = 0; i < corners; i++)
        for (let k = 0; k < 3; k++) mesh.inner[3 * i + k] = (arrays.inner[(i / 3) | 0] >> k) & 1;
    return mesh;
}

// ---- What is shown ----------------------------------------------------------------------------------

const VERTEX = `
in vec3 light, reflectance, emission, inner;
in vec2 place;
out vec3 H, rho, E, side, within;
out vec2 st;
void main() {
    H = light; rho = reflectance; E = emission; within = inner; st = place;
    int corner = gl_VertexID % 3;
    side = vec3(corner == 0, corner == 1, corner == 2);
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;
const FRAGMENT = `
precision highp float;
in vec3 H, rho, E, side, within;
in vec2 st;
out vec4 color;
uniform float exposure, most;
uniform bool outlines, lux, textured;
uniform vec3 luminous, stops[6];
uniform sampler2D map;
vec3 srgb(vec3 x) {
    x = clamp(x, 0.0, 1.0);
    return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
void main() {
    if (lux) {
        float share = clamp(dot(H, luminous) / most, 0.0, 1.0) * 5.0;
        int k = min(int(share), 4);
        color = vec4(mix(stops[k], stops[k + 1], share - float(k)), 1.0);
        return;
    }
    vec3 L = (E + (textured ? texture(map, st).rgb : rho) * H) / ${Math.PI};
    if (outlines) {
        vec3 away = side / max(fwidth(side), vec3(1e-9)) + 1e9 * within;
        L *= mix(1.0, 0.25, clamp(1.0 - min(away.x, min(away.y, away.z)), 0.0, 1.0));
    }
    color = vec4(srgb(L * exposure), 1.0);
}`;
// Dark to bright, also in grey.
const STOPS = [[0.04, 0.03, 0.15], [0.32, 0.07, 0.48], [0.72, 0.21, 0.47], [0.97, 0.45, 0.33], [0.99, 0.78, 0.4], [1, 1, 0.85]];

const uniforms = {
    exposure: { value: data.exposure }, most: { value: 1 }, outlines: { value: false }, lux: { value: false },
    luminous: { value: new THREE.Vector3(...data.luminous) }, stops: { value: STOPS.flat() },
};

function material(texture) {
    const own = { textured: { value: Boolean(texture) }, map: { value: texture || null } };
    return new THREE.ShaderMaterial({
        glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { ...uniforms, ...own },
    });
}

function pictures() {
    return Promise.all(data.textures.map(async (base64) => {
        const image = new Image();
        image.src = `data:image/png;base64,${base64}`;
        await image.decode();
        const texture = new THREE.Texture(image);
        Object.assign(texture, { flipY: false, colorSpace: THREE.SRGBColorSpace, anisotropy: 8, needsUpdate: true });
        return texture;
    }));
}

const WHITE = [1, 1, 1];
/** What the emission of a lamp is multiplied by, RGB. */
const scaleOf = (lamp) => (lamp === null ? WHITE : data.lamps[lamp].scale);

/** The weights of the layers in a mode, RGB: what of the irradiance counts. */
function weights(mode) {
    const counts = (layer) => Number((mode !== "direct" && mode !== "indirect") || layer.kind === mode);
    return data.layers.map((layer) => scaleOf(layer.lamp).map((s) => s * counts(layer)));
}

/** The weighted sum of layers, spread over the corners. */
function sum({ layers, of }, factors, result) {
    if (layers.length === 0) return result.fill(0);
    const total = new Float32Array(layers[0].length);
    layers.forEach((layer, k) => {
        if (factors[k].some(Boolean)) for (let i = 0; i < total.length; i++) total[i] += factors[k][i % 3] * layer[i];
    });
    for (let i = 0; 3 * i < result.length; i++)
        for (let c = 0, from = 3 * of(i); c < 3; c++) result[3 * i + c] = total[from + c];
}

/** Adds what the emitters emit. */
function shine(mesh, result) {
    for (const { start, count, lamp } of data.parts) {
        const scale = scaleOf(lamp);
        for (let i = 3 * start; i < 3 * (start + count); i++) result[i] += scale[i % 3] * mesh.emission[i];
    }
}

const linear = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

/** A slider and a colour for each lamp; ``changed`` is called when one moves. */
function desk(changed) {
    element("lamps").hidden = !data.lamps.length;
    const show = data.lamps.map((lamp) => {
        const label = document.createElement("label"), said = document.createElement("output");
        const [level, color] = ["range", "color"].map((type) => Object.assign(document.createElement("input"), { type }));
        let tint = WHITE;
        Object.assign(level, { min: 0, step: 0.01, ariaLabel: `${lamp.name}, brightness` });
        Object.assign(color, { ariaLabel: `${lamp.name}, colour`, title: "what its colour is multiplied by" });
        label.append(`${lamp.name} `, said, level, color);
        element("lamps").append(label);
        const show = () => {
            const most = Math.max(...lamp.scale), byte = (c) => Math.round(255 * encoded(c)).toString(16).padStart(2, "0");
            if (most > 0) tint = lamp.scale.map((s) => s / most); // of a lamp that is off, as it was
            level.max = Math.max(2, most, level.max);
            level.value = most;
            color.value = `#${tint.map(byte).join("")}`;
            said.textContent = `× ${Number(most.toPrecision(3))}`;
        };
        level.addEventListener("input", () => {
            lamp.scale = tint.map((c) => c * level.value);
            said.textContent = `× ${level.value}`;
            changed();
        });
        color.addEventListener("input", () => {
            tint = [1, 3, 5].map((k) => linear(parseInt(color.value.slice(k, k + 2), 16) / 255));
            lamp.scale = tint.map((c) => c * level.value);
            changed();
        });
        return show;
    });
    return () => show.forEach((f) => f());
}

// ---- Walking ----------------------------------------------------------------------------------------

class Walker {
    constructor(camera, changed) {
        this.camera = camera;
        this.changed = changed;
        this.keys = new Set();
        this.hurry = 1;
        this.touches = new Map();
        this.up = new THREE.Vector3(...data.up);
        this.speed = data.size / 8; // m/s
        canvas.addEventListener("pointerdown", (event) => this.press(event));
        canvas.addEventListener("pointermove", (event) => this.move(event));
        for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.release(event));
        canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
        addEventListener("keydown", (event) => this.key(event, true));
        addEventListener("keyup", (event) => this.key(event, false));
        addEventListener("blur", () => this.keys.clear());
    }

    /** Stand where a sensor of the scene stands. */
    stand(view) {
        this.camera.matrixWorld.set(...view.matrix);
        this.camera.matrixWorld.decompose(this.camera.position, this.camera.quaternion, this.camera.scale);
        this.camera.scale.set(1, 1, 1);
        this.camera.fov = view.fov;
        this.camera.updateProjectionMatrix();
        this.changed();
    }

    axis(x, y, z) {
        return new THREE.Vector3(x, y, z).applyQuaternion(this.camera.quaternion);
    }

    turn(across, down) {
        const ahead = this.axis(0, 0, -1), steep = Math.asin(Math.max(-1, Math.min(1, ahead.dot(this.up))));
        const tilt = Math.max(-1.55, Math.min(1.55, steep - down)) - steep;
        this.camera.quaternion.premultiply(new THREE.Quaternion().setFromAxisAngle(this.axis(1, 0, 0), tilt));
        this.camera.quaternion.premultiply(new THREE.Quaternion().setFromAxisAngle(this.up, -across));
        const level = this.axis(0, 0, -1).cross(this.up);
        if (level.lengthSq() > 1e-6) { // upright, whatever the sensor's roll
            const target = this.axis(0, 0, -1).add(this.camera.position);
            this.camera.up.copy(this.up);
            this.camera.lookAt(target);
        }
        this.changed();
    }

    step(right, rise, ahead) {
        const forward = this.axis(0, 0, -1);
        forward.addScaledVector(this.up, -forward.dot(this.up)).normalize();
        this.camera.position.addScaledVector(this.axis(1, 0, 0), right).addScaledVector(this.up, rise).addScaledVector(forward, ahead);
        this.changed();
    }

    press(event) {
        canvas.setPointerCapture(event.pointerId);
        canvas.focus();
        this.touches.set(event.pointerId, [event.clientX, event.clientY]);
        this.dragged = this.touches.size > 1 ? Infinity : 0;
    }

    move(event) {
        const before = this.touches.get(event.pointerId);
        if (!before) return;
        const x = event.clientX - before[0], y = event.clientY - before[1], fingers = this.touches.size;
        this.touches.set(event.pointerId, [event.clientX, event.clientY]);
        this.dragged += Math.abs(x) + Math.abs(y);
        const angle = (this.camera.fov * Math.PI) / 180 / innerHeight;
        if (fingers > 1) this.step((x * this.speed) / 400, 0, (-y * this.speed) / 200);
        else if (this.dragged > 4) this.turn(-x * angle, -y * angle);
    }

    release(event) {
        if (this.touches.delete(event.pointerId) && this.dragged <= 4 && event.type === "pointerup") this.clicked(event);
    }

    wheel(event) {
        event.preventDefault();
        const way = this.axis(0, 0, -1).multiplyScalar((-Math.sign(event.deltaY) * this.speed) / 10);
        this.camera.position.add(way);
        this.changed();
    }

    key(event, down) {
        if (event.target.matches?.("select, input") && event.code.startsWith("Arrow")) return;
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        if (down && event.code === "KeyH") document.body.classList.toggle("bare");
        this.keys[down ? "add" : "delete"](event.code);
        this.hurry = event.shiftKey ? 3 : 1;
        this.changed();
    }

    /** Go on for some seconds by the keys that are held; says whether any is. */
    walk(seconds) {
        const held = (...codes) => Number(codes.some((code) => this.keys.has(code)));
        const way = [
            held("KeyD", "ArrowRight") - held("KeyA", "ArrowLeft"),
            held("KeyE", "PageUp") - held("KeyQ", "PageDown"),
            held("KeyW", "ArrowUp") - held("KeyS", "ArrowDown"),
        ];
        if (!way.some(Boolean)) return false;
        this.step(...way.map((d) => d * this.speed * this.hurry * seconds));
        return true;
    }
}

// ---- The light at a point ---------------------------------------------------------------------------

/** The nearest front of a triangle along a ray: its first corner, and the weights of its corners. */
function trace(mesh, origin, way) {
    const p = mesh.position, o = origin.toArray(), d = way.toArray();
    let found = null, nearest = Infinity;
    for (let i = 0; i < p.length; i += 9) {
        const ax = p[i], ay = p[i + 1], az = p[i + 2];
        const ux = p[i + 3] - ax, uy = p[i + 4] - ay, uz = p[i + 5] - az, vx = p[i + 6] - ax, vy = p[i + 7] - ay, vz = p[i + 8] - az;
        const hx = d[1] * vz - d[2] * vy, hy = d[2] * vx - d[0] * vz, hz = d[0] * vy - d[1] * vx;
        const det = ux * hx + uy * hy + uz * hz;
        if (det <= 0) continue; // seen from behind
        const sx = o[0] - ax, sy = o[1] - ay, sz = o[2] - az, u = (sx * hx + sy * hy + sz * hz) / det;
        if (u < 0 || u > 1) continue;
        const qx = sy * uz - sz * uy, qy = sz * ux - sx * uz, qz = sx * uy - sy * ux;
        const v = (d[0] * qx + d[1] * qy + d[2] * qz) / det, t = (vx * qx + vy * qy + vz * qz) / det;
        if (v < 0 || u + v > 1 || t <= 0 || t >= nearest) continue;
        nearest = t;
        found = { corner: i / 3, weights: [1 - u - v, u, v], point: way.clone().multiplyScalar(t).add(origin) };
    }
    return found;
}

const digits = (x) => (x === 0 ? "0" : x >= 1000 ? Math.round(x).toLocaleString() : x.toPrecision(3));

function reading(mesh, hit) {
    const factors = weights("shaded");
    const at = (values, place = (i) => i) =>
        [0, 1, 2].map((c) => hit.weights.reduce((s, w, k) => s + w * values[3 * place(hit.corner + k) + c], 0));
    const total = ({ layers, of }) => {
        const light = layers.map((layer) => at(layer, of));
        return [0, 1, 2].map((c) => light.reduce((s, x, k) => s + factors[k][c] * x[c], 0));
    };
    const H = total(mesh.smooth), through = total(mesh.through.smooth);
    const part = data.parts.find((p) => hit.corner >= p.start && hit.corner < p.start + p.count), scale = scaleOf(part.lamp);
    const rho = at(mesh.reflectance), E = at(mesh.emission), B = H.map((h, c) => scale[c] * E[c] + rho[c] * h + through[c]);
    const lux = H.reduce((s, h, c) => s + h * data.luminous[c], 0);
    const three = (x) => x.map(digits).join("  ");
    const lines = [`${digits(lux)} lx`, `irradiance  ${three(H)}  W/m²`];
    if (part.texture === null) lines.push(`radiosity   ${three(B)}  W/m²`);
    return [...lines, part.name + (part.back ? ", back" : "")].join("\n");
}

// ---- All together -----------------------------------------------------------------------------------

/** "NAME:0.5" or "NAME:1,0.8,0.6": the name of a lamp, and its scale. */
function dimming(text) {
    const colon = text.lastIndexOf(":"), scale = text.slice(colon + 1).split(",").map((x) => Math.max(Number(x) || 0, 0));
    return [text.slice(0, colon), scale.length === 3 ? scale : WHITE.map(() => scale[0])];
}

async function main() {
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // the shader knows what it does
    const mesh = await load(), textures = await pictures();
    const geometry = new THREE.BufferGeometry(), light = new Float32Array(3 * mesh.corners), emission = light.slice();
    const attributes = { position: mesh.position, light, reflectance: mesh.reflectance, emission, inner: mesh.inner };
    for (const [name, values] of Object.entries(attributes)) geometry.setAttribute(name, new THREE.BufferAttribute(values, 3));
    geometry.setAttribute("place", new THREE.BufferAttribute(mesh.uv, 2));
    const materials = [material(null), ...textures.map(material)];
    for (const part of data.parts) geometry.addGroup(part.start, part.count, part.texture === null ? 0 : part.texture + 1);
    // Backs are pushed away, lest they show along edges, where they meet fronts.
    const offset = { polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 16 };
    const black = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: 0, side: THREE.BackSide, ...offset }));
    const scene = new THREE.Scene();
    for (const object of [new THREE.Mesh(geometry, materials), black]) {
        object.frustumCulled = false;
        scene.add(object);
    }

    const camera = new THREE.PerspectiveCamera(50, 1, data.size / 2000, data.size * 20);
    let asked = false, stale = true, last = 0, hit = null;
    const changed = () => {
        if (asked) return;
        asked = true;
        requestAnimationFrame(draw);
    };
    const walker = new Walker(camera, changed);
    const mode = element("mode"), slider = element("exposure"), chosen = element("view");

    function draw(now) {
        asked = false;
        const walking = walker.walk(Math.min((now - last) / 1000, 0.1));
        last = now;
        if (stale) relight();
        renderer.render(scene, camera);
        mark();
        if (walking) changed();
    }

    function mark() {
        const seen = hit && hit.point.clone().project(camera);
        element("mark").style.display = seen && Math.abs(seen.z) < 1 ? "block" : "none";
        if (seen) element("mark").style.left = `${((seen.x + 1) / 2) * innerWidth}px`;
        if (seen) element("mark").style.top = `${((1 - seen.y) / 2) * innerHeight}px`;
    }

    const lit = () => {
        stale = true;
        changed();
    };

    /** The sum of the layers, once a picture. */
    function relight() {
        stale = false;
        const name = mode.value;
        const kind = name === "flat" ? "flat" : "smooth";
        sum(mesh[kind], weights(name), light);
        sum(mesh.through[kind], weights(name), emission);
        if (name !== "indirect") shine(mesh, emission);
        for (const changing of ["light", "emission"]) geometry.attributes[changing].needsUpdate = true;
        read();
        uniforms.outlines.value = name === "mesh";
        uniforms.lux.value = name === "lux";
        uniforms.most.value = data.most;
        element("scale").style.display = name === "lux" ? "block" : "none";
    }

    function read() {
        element("reading").style.display = hit ? "block" : "none";
        if (hit) element("reading").textContent = reading(mesh, hit);
    }

    function scale() {
        const row = (k) => `<div>${digits((data.most * k) / 10)}<i style="background:${tint(k / 2)}"></i></div>`;
        element("scale").innerHTML = `lx${[10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0].map(row).join("")}`;
    }

    function tint(place) {
        const k = Math.min(Math.floor(place), 4), mix = (c) => STOPS[k][c] + (STOPS[k + 1][c] - STOPS[k][c]) * (place - k);
        return `rgb(${[0, 1, 2].map((c) => Math.round(255 * mix(c)))})`;
    }

    function expose() {
        uniforms.exposure.value = 2 ** slider.value;
        element("stops").textContent = `× ${Number(2 ** slider.value).toPrecision(3)}`;
        changed();
    }

    function resize() {
        renderer.setPixelRatio(devicePixelRatio);
        renderer.setSize(innerWidth, innerHeight);
        camera.aspect = innerWidth / innerHeight;
        camera.updateProjectionMatrix();
        changed();
    }

    walker.clicked = (event) => {
        const corner = new THREE.Vector3((event.clientX / innerWidth) * 2 - 1, 1 - (event.clientY / innerHeight) * 2, 0.5);
        camera.updateMatrixWorld();
        hit = trace(mesh, camera.position, corner.unproject(camera).sub(camera.position).normalize());
        read();
        changed();
    };
    mode.addEventListener("change", lit);
    slider.addEventListener("input", expose);
    chosen.addEventListener("change", () => walker.stand(data.views[chosen.value]));
    element("solid").addEventListener("change", (event) => {
        black.visible = event.target.checked;
        changed();
    });
    addEventListener("resize", resize);

    const show = desk(lit);
    /** What the emission of lamps is multiplied by from now on: their names, and RGB. */
    function dim(scales) {
        for (const lamp of data.lamps) lamp.scale = scales[lamp.name] || lamp.scale;
        show();
        lit();
    }

    // #mode=lux&view=1&exposure=2&lamp=NAME:0.5&lamp=OTHER:1,0.8,0.6&bare opens the page like that.
    const asks = new URLSearchParams(location.hash.slice(1));
    if ([...mode.options].some((option) => option.value === asks.get("mode"))) mode.value = asks.get("mode");
    document.body.classList.toggle("bare", asks.has("bare"));
    slider.value = Math.log2(Number(asks.get("exposure")) || data.exposure);
    data.views.forEach((view, k) => chosen.add(new Option(view.name, k)));
    chosen.value = Math.min(Number(asks.get("view")) || 0, data.views.length - 1);
    element("views").hidden = data.views.length < 2;
    resize();
    walker.stand(data.views[chosen.value]);
    scale();
    dim(Object.fromEntries(asks.getAll("lamp").map(dimming)));
    expose();
    window.viewer = { camera, walker, mesh, data, dim, ready: true };
}

main().catch((error) => {
    const fault = document.createElement("div");
    fault.id = "fault";
    fault.textContent = `This page needs a browser with WebGL 2: ${error.message}`;
    document.body.append(fault);
});
