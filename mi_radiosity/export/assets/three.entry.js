export {
    BackSide, BufferAttribute, BufferGeometry, FrontSide, GLSL3, LinearFilter, LinearMipmapLinearFilter, LinearSRGBColorSpace,
    Matrix4, Mesh, MeshBasicMaterial, PerspectiveCamera, Quaternion, Scene, ShaderMaterial, SRGBColorSpace, Texture, Vector3,
    WebGLRenderer,
} from "three";
