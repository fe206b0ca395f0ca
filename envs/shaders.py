"""GLSL of the pyrender renderer: exact outlines and exact light of round bodies, and textures.

A round body is drawn as few triangles that face the camera. The vertex shader turns every
ring of a pole or a cone so that two of its corners lie where the line of sight touches the
body, and draws an ellipsoid as the disc of those points; the fragment shader takes the line
of sight on to the surface x^2 + y^2 = A + B z + C z^2 around the centre of the body, and
shades that point. Flat faces are drawn as they are. Surface coordinates of textures come
from the line of sight as well, not from interpolation, which is too coarse far away.
"""

# What `surface.x` says of a vertex. FACE_X .. FACE_Z are flat, named by the axis of their
# normal; RIM is a level face of a round body, SIDE and DISC are its round part.
FACE_X, FACE_Y, FACE_Z, GROUND, MESH, RIM, SIDE, DISC = range(8)
# What `surface.y` says: which texture.
NONE, ON_GROUND, ON_WALLS, ON_OBSTACLES = range(4)

_HEAD = """#version 330 core
const int FACE_X = 0, FACE_Y = 1, FACE_Z = 2, GROUND = 3, MESH = 4, RIM = 5, SIDE = 6, DISC = 7;
const int CHECKER = 1, STRIPES = 2, RINGS = 3, NOISE = 4;
uniform mat4 V, P;       // pyrender's: world to camera, camera to clip space
uniform vec3 cam_pos;    // pyrender's: where the camera is
"""

VERTEX = """
layout(location = 0) in vec3 position;  // of a flat vertex, or the centre of a round body
layout(location = 1) in vec3 ring;      // angle of the corner, radius of the ring, its height over the centre
layout(location = 2) in vec4 quadric;   // A, B, C and metres of texture per radian
layout(location = 3) in vec2 surface;   // shape and texture
layout(location = 4) in vec2 origin;    // surface coordinates of the centre
layout(location = 5) in vec4 body;      // luminance or albedo, radius, half height, corners per quarter

flat out vec3 centre;
flat out vec4 round_body;
centroid out float light;
flat out int shape;

#ifdef TEXTURED
uniform vec3 around[4];     // the camera's position, reduced by whole repeats of the texture [m]
uniform vec2 moved[4];      // how far the texture has moved [m], reduced likewise
uniform int patterns[4];
uniform vec2 scales[4];     // 1 / period [1/m], contrast
flat out int pattern, layer;
flat out vec2 scale, start;
flat out float plane;
#endif

// A corner of a ring. The angle counts from the direction of the eye, stretched so that a quarter
// turn either way is where the line of sight touches the body. The other corners lie a little
// outside, so that the mean radius of the polygon between them is right.
vec3 on_ring(vec3 eye) {
    float away = max(length(eye.xy), 1e-6);
    vec2 x = length(eye.xy) > 1e-6 ? eye.xy / away : vec2(1.0, 0.0), y = vec2(-x.y, x.x);
    float slope = ring.y > 0.0 ? 0.5 * (quadric.y + 2.0 * quadric.z * ring.z) / ring.y : 0.0;
    float touch = acos(clamp((ring.y - slope * (ring.z - eye.z)) / away, -1.0, 1.0));
    float turns = abs(ring.x) / 1.57079632679, span = turns <= 1.0 ? touch : 3.14159265359 - touch;
    float angle = sign(ring.x) * (turns <= 1.0 ? turns * span : touch + (turns - 1.0) * span);
    float half_step = max(0.5 * span / body.w, 1e-4);
    float radius = ring.y * (abs(turns - 1.0) < 1e-3 ? 1.0 : half_step / sin(half_step));
    return vec3(radius * (cos(angle) * x + sin(angle) * y), ring.z);
}

vec3 on_disc(vec3 eye) {
    vec3 axes = vec3(body.y, body.y, body.z);
    vec3 seen = eye / axes;
    float square = dot(seen, seen);
    if (square <= 1.0) return vec3(0.0);  // from its inside a body cannot be seen
    vec3 across = abs(seen.z) < 0.9 * sqrt(square) ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0);
    across = normalize(cross(across, seen));
    vec3 up = cross(seen, across) / sqrt(square);
    float radius = ring.y * sqrt(1.0 - 1.0 / square);
    return axes * (seen / square + radius * (cos(ring.x) * across + sin(ring.x) * up));
}

void main() {
    shape = int(surface.x + 0.5);
    round_body = quadric;
    light = body.x;
    centre = position - cam_pos;
    vec3 point = centre;
    if (shape >= RIM) point += shape == DISC ? on_disc(-centre) : on_ring(-centre);
    // Follows the camera, which never is within its plane.
    if (shape == GROUND) point = vec3(position.xy * max(1.0, 0.1 * cam_pos.z), -max(cam_pos.z, 1e-6));
#ifdef TEXTURED
    layer = int(surface.y + 0.5);
    pattern = patterns[layer];
    scale = scales[layer];
    vec3 eye = around[layer];
    start = shape >= SIDE ? origin : shape == FACE_X ? eye.yz : shape == FACE_Y ? eye.xz : eye.xy;
    start -= moved[layer];
    plane = shape == FACE_X ? point.x : shape == FACE_Y ? point.y : point.z;
#endif
    gl_Position = P * vec4(mat3(V) * point, 1.0);
    // The farthest depth that is not that of the sky.
    if (shape == GROUND) gl_Position.z = min(gl_Position.z, gl_Position.w * (1.0 - 2e-7));
    // A face cannot be seen from within its plane.
    if (shape < GROUND && abs(point[shape]) < 1e-6) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}
"""

FRAGMENT = """
flat in vec3 centre;  // of a round body, from the camera [m]
flat in vec4 round_body;
centroid in float light;
flat in int shape;
out vec4 luminance;

uniform vec3 lens;       // half the width, half the height, 1 / focal length [pixels]
uniform vec3 sun;
uniform vec2 lambert;    // ambient, diffuse

// From the centre of a round body to the point where the line of sight enters it. Only the depth is
// taken from the triangle, which lies inside, so that rounded corners do not displace the point.
vec3 on_surface(vec3 ray) {
    vec3 local = ray / gl_FragCoord.w - centre;
    float a = dot(ray.xy, ray.xy) - round_body.z * ray.z * ray.z;
    float b = dot(local.xy, ray.xy) - (0.5 * round_body.y + round_body.z * local.z) * ray.z;
    float c = dot(local.xy, local.xy) - round_body.x - (round_body.y + round_body.z * local.z) * local.z;
    float square = b * b - a * c;
    float below = sqrt(max(square, 0.0)) - b;
    return square > 0.0 && abs(below) > 1e-12 ? local + c / below * ray : local;
}

#ifdef TEXTURED
flat in int pattern, layer;
flat in vec2 scale, start;
flat in float plane;         // distance of a flat face along its normal [m]
uniform sampler2D tiles;     // of the noise, one layer above the other
uniform int texels, periods; // of a tile

float noise(vec2 at) {
    vec2 place = at * (float(texels) / float(periods));
    vec2 corner = floor(place), part = place - corner;
    ivec2 one = ivec2(mod(corner, float(texels))), next = (one + 1) % texels;
    ivec2 first = ivec2(0, (layer - 1) * texels);
    float a = texelFetch(tiles, first + one, 0).r, b = texelFetch(tiles, first + ivec2(next.x, one.y), 0).r;
    float c = texelFetch(tiles, first + ivec2(one.x, next.y), 0).r, d = texelFetch(tiles, first + next, 0).r;
    return mix(mix(a, b, part.x), mix(c, d, part.x), part.y);
}

float pattern_at(vec2 metres) {
    vec2 at = metres * scale.x;
    if (pattern == NOISE) return noise(at);
    vec2 wave = 1.0 - 2.0 * step(0.5, fract(at));
    return pattern == CHECKER ? wave.x * wave.y : pattern == STRIPES ? wave.x : wave.y;
}

// Surface coordinates of `hit`, on a round body, or of where the line of sight meets a flat face.
vec2 coordinates(vec3 ray, vec3 hit) {
    if (shape >= SIDE) return start + vec2(round_body.w * atan(hit.y, hit.x), hit.z);
    float across = shape == FACE_X ? ray.x : shape == FACE_Y ? ray.y : ray.z;
    vec2 along = shape == FACE_X ? ray.yz : shape == FACE_Y ? ray.xz : ray.xy;
    return start + along * clamp(plane / across, 0.0, 1e6);
}
#endif

void main() {
    vec2 slope = (gl_FragCoord.xy - lens.xy) * lens.z;
    vec3 ray = vec3(slope, -1.0) * mat3(V);  // times the inverse of a rotation
    vec3 hit = vec3(0.0);
    float value = light;
    if (shape >= SIDE) {
        hit = on_surface(ray);
        vec3 normal = vec3(hit.xy, -0.5 * round_body.y - round_body.z * hit.z);
        float facing = max(0.0, dot(normal, sun)) / max(length(normal), 1e-12);
        value *= lambert.x + lambert.y * facing;
    }
#ifdef TEXTURED
    if (pattern > 0) value *= 1.0 + scale.y * pattern_at(coordinates(ray, hit));
#endif
    luminance = vec4(value);
}
"""


def source(stage: str, textured: bool) -> str:
    """The whole text of one stage, VERTEX or FRAGMENT; without textures, plain scenes do not pay for them."""
    return _HEAD + ("#define TEXTURED\n" if textured else "") + stage
