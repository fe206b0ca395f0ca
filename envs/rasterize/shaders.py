"""GLSL of the pyrender renderer: exact outlines and exact light of round bodies, and textures.

A round body is drawn as few triangles that face the camera. The vertex shader turns every
ring of a pole or a cone so that two of its corners lie where the line of sight touches the
body. It draws an ellipsoid as the disc bounded by those points. The fragment shader extends
the line of sight to the surface x^2 + y^2 = A + B z + C z^2 around the centre of the body, and
shades that point. Flat faces are drawn unchanged. Surface coordinates of textures are computed
from the line of sight as well, because interpolation is too coarse far away.

Every kind of surface with every pattern has its own program, because software rendering pays
for both sides of a branch. Small triangles cost most, so corners too close to be told apart
are merged.
"""

from envs.scene.textures import PATTERNS, TILE, TILE_PERIODS

# Kinds of surfaces in the order of drawing: those that hide most come first, so that less is
# shaded twice. SIDE and DISC are round, RIM is a level face of a round body.
SURFACES = ("side", "disc", "face", "rim", "mesh", "wall", "ground")
SIDE, DISC, FACE, RIM, MESH, WALL, GROUND = range(7)
# The texture of each kind: 0 ground, 1 walls, 2 obstacles; a mesh has none.
TEXTURE_OF = (2, 2, 2, 2, None, 1, 0)

# Largest number of corners of a ring and of an ellipsoid's outline. Sides and outlines of poles and
# cones are exact with any number; the rims of poles and the outlines of ellipsoids are polygons.
RING, OUTLINE = 24, 48

_NAMES = [*enumerate(SURFACES), *enumerate(PATTERNS)]
_HEAD = f"""#version 330 core
const float QUARTER = {RING // 4}.0, OUTLINE = {OUTLINE}.0, TILE = {TILE}.0, TILE_PERIODS = {TILE_PERIODS}.0;
"""

# The same for all programs; `envs.rasterize.renderer.FRAME` has its memory layout.
_FRAME = """
layout(std140, row_major) uniform Frame {
    mat4 clip;       // from directions of the world, as seen from the camera, to clip space
    mat4 view;       // from directions of the world to those of the camera
    vec4 camera;     // where it is
    vec4 lens;       // half the width, half the height, 1 / focal length [pixels]
    vec4 sun;
    vec4 lambert;    // ambient, diffuse
    vec4 around[3];  // the camera's position, reduced by whole repeats of the texture [m]
    vec4 moved[3];   // how far the texture has moved [m], reduced likewise
    vec4 looks[3];   // 1 / period [1/m], contrast
};
"""

VERTEX = """
layout(location = 0) in vec3 position;  // of a flat vertex, or the centre of a round body
layout(location = 1) in vec3 ring;      // number of the corner, radius and height over the centre of its ring
layout(location = 2) in vec4 quadric;   // A, B, C and metres of texture per radian
layout(location = 3) in vec2 origin;    // surface coordinates of the centre
layout(location = 4) in vec4 body;      // luminance or albedo, radius, half height, axis of a face's normal

flat out vec3 centre;
flat out vec4 round_body;
flat out vec2 start;
flat out float plane;
flat out int axis;
#if SURFACE == MESH
centroid out float light;
#else
flat out float light;
#endif

// How many corners a curve needs so that the arc between two of them rises over its chord by no more
// than `allowed`, if with one corner it would rise by `pixels`: for a radius and an angle per corner,
// radius * angle^2 / 8.
float corners_for(float pixels, float allowed, float least, float most) {
    return clamp(ceil(sqrt(pixels / allowed)), least, most);
}

// A corner of a ring; they are numbered from the direction of the eye, so many to a quarter that is
// stretched to end where the line of sight touches the body. The other corners lie a little
// outside, so that the mean radius of the polygon between them is right.
vec3 on_ring(vec3 eye) {
    float away = max(length(eye.xy), 1e-6);
    vec2 x = length(eye.xy) > 1e-6 ? eye.xy / away : vec2(1.0, 0.0), y = vec2(-x.y, x.x);
    float slope = ring.y > 0.0 ? 0.5 * (quadric.y + 2.0 * quadric.z * ring.z) / ring.y : 0.0;
    float touch = acos(clamp((ring.y - slope * (ring.z - eye.z)) / away, -1.0, 1.0));
    float gap = max(away - ring.y, 1e-6), tilt = max(abs(ring.z - eye.z), 0.25 * ring.y);
    float quarter = corners_for(0.31 * ring.y * tilt / (gap * gap * lens.z), 0.016, 1.0, QUARTER);
    float corner = floor((abs(ring.x) * quarter + 0.5) / QUARTER);
    float span = corner <= quarter ? touch : 3.14159265359 - touch;
    float angle = corner <= quarter ? corner / quarter * span : touch + (corner / quarter - 1.0) * span;
    angle *= sign(ring.x);
    float half_step = max(0.5 * span / quarter, 1e-4);
    float radius = ring.y * (corner == quarter ? 1.0 : half_step / sin(half_step));
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
    float large = max(body.y, body.z), gap = max(length(eye) - large, 1e-6);
    float corners = corners_for(4.93 * large / (gap * lens.z), 0.01, 8.0, OUTLINE);
    float turn = 6.28318530718 / corners, angle = turn * floor((ring.x * corners + 0.5) / OUTLINE);
    float radius = sqrt(1.0 - 1.0 / square) * 0.5 * turn / sin(0.5 * turn);
    return axes * (seen / square + radius * (cos(angle) * across + sin(angle) * up));
}

void main() {
    round_body = quadric;
    light = body.x;
    axis = SURFACE == FACE ? int(body.w + 0.5) : SURFACE == WALL ? 0 : 2;
    centre = position - camera.xyz;
    vec3 point = centre;
#if SURFACE == SIDE || SURFACE == RIM
    point += on_ring(-centre);
#elif SURFACE == DISC
    point += on_disc(-centre);
#elif SURFACE == GROUND
    // Follows the camera, which never is within its plane.
    point = vec3(position.xy * max(1.0, 0.1 * camera.z), -max(camera.z, 1e-6));
#endif
#if PATTERN != PLAIN
    vec3 eye = around[TEXTURE].xyz;
    start = SURFACE <= DISC ? origin : axis == 0 ? eye.yz : axis == 1 ? eye.xz : eye.xy;
    start -= moved[TEXTURE].xy;
    plane = point[axis];
#endif
    gl_Position = clip * vec4(point, 1.0);
#if SURFACE == GROUND
    // The farthest depth that is not that of the sky.
    gl_Position.z = min(gl_Position.z, gl_Position.w * (1.0 - 2e-7));
#elif SURFACE == FACE || SURFACE == WALL
    // A face cannot be seen from within its plane.
    if (abs(point[axis]) < 1e-6) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
#endif
}
"""

FRAGMENT = """
flat in vec3 centre;      // of a round body, from the camera [m]
flat in vec4 round_body;
flat in vec2 start;       // surface coordinates that belong to the camera's place, or to the centre
flat in float plane;      // distance of a flat face along its normal [m]
flat in int axis;         // of a flat face's normal
#if SURFACE == MESH
centroid in float light;
#else
flat in float light;
#endif
out float luminance;
uniform sampler2D tile;   // of the noise

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

float pattern_at(vec2 at) {
#if PATTERN == NOISE
    return textureLod(tile, at / TILE_PERIODS + 0.5 / TILE, 0.0).r;
#else
    vec2 wave = 1.0 - 2.0 * step(0.5, fract(at));
    return PATTERN == CHECKER ? wave.x * wave.y : PATTERN == STRIPES ? wave.x : wave.y;
#endif
}

// Surface coordinates of `hit`, on a round body, or of where the line of sight meets a flat face.
vec2 coordinates(vec3 ray, vec3 hit) {
    if (SURFACE <= DISC) return start + vec2(round_body.w * atan(hit.y, hit.x), hit.z);
    vec2 along = axis == 0 ? ray.yz : axis == 1 ? ray.xz : ray.xy;
    return start + along * clamp(plane / ray[axis], 0.0, 1e6);
}

void main() {
    vec2 slope = (gl_FragCoord.xy - lens.xy) * lens.z;
    vec3 ray = vec3(slope, -1.0) * mat3(view);  // times the inverse of a rotation
    vec3 hit = vec3(0.0);
    luminance = light;
#if SURFACE <= DISC
    hit = on_surface(ray);
    vec3 normal = vec3(hit.xy, -0.5 * round_body.y - round_body.z * hit.z);
    float facing = max(0.0, dot(normal, sun.xyz)) / max(length(normal), 1e-12);
    luminance *= lambert.x + lambert.y * facing;
#endif
#if PATTERN != PLAIN
    vec2 look = looks[TEXTURE].xy;
    luminance *= 1.0 + look.y * pattern_at(coordinates(ray, hit) * look.x);
#endif
}
"""


def source(stage: str, surface: int, pattern: int) -> str:
    """Return the source of one stage, VERTEX or FRAGMENT, for a kind of surface with a pattern."""
    names: dict[str, int | None] = {name.upper(): i for i, name in _NAMES}
    names |= {"SURFACE": surface, "PATTERN": pattern, "TEXTURE": TEXTURE_OF[surface]}
    return _HEAD + "".join(f"#define {name} {value}\n" for name, value in names.items()) + _FRAME + stage
