/* StreetForward for C. C99 or C++; link with libstreetforward.so or .a.
 *
 * Functions return 0 or a status, the same number as the exit code of the command line. sf_last_error has the message: one line,
 * for the last failed call of the thread. No function ends the process or lets a panic out.
 *
 * Handles are numbers. 0 is none; a wrong or destroyed one, one made before a fork, and one that another thread is using give
 * SF_USAGE. Handles may be used from any thread, one call at a time; different handles at the same time.
 *
 * A struct starts with its size: set struct_size to sizeof. Arrays are borrowed for the length of a call.
 */
#ifndef STREETFORWARD_H
#define STREETFORWARD_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Of this header; sf_abi_version has that of the library. */
#define SF_ABI_VERSION 1

typedef int sf_status;
enum {
    SF_OK = 0,
    SF_CHECK_FAILED = 1, /* a check ran and failed */
    SF_USAGE = 2,        /* wrong arguments or handles */
    SF_INPUT = 3,        /* scene, camera or gradient rejected */
    SF_MODEL = 4,        /* blob or checkpoint rejected */
    SF_RESOURCE = 5,     /* memory, threads or another budget */
    SF_IO = 6,           /* reading or writing failed */
    SF_UNSUPPORTED = 7,  /* understood, but not supported here */
    SF_DEADLINE = 8,     /* cancelled, or too late */
    SF_INTEGRITY = 9,    /* digest mismatch, self-test failed */
    SF_INTERNAL = 70,    /* a bug of ours; the handle is spent */
    SF_INTERRUPTED = 130
};

/* Threads. */
typedef uint64_t sf_context;
/* One image of Gaussians at a time, and the way back from it. Keeps its memory between images. */
typedef uint64_t sf_raster;

uint32_t sf_abi_version(void);
/* Static, never freed. */
const char *sf_version(void);
/* Copies the message of this thread's last failed call, cut to capacity - 1 bytes; returns the size that holds all of it, its
 * zero included. buffer may be NULL. */
size_t sf_last_error(char *buffer, size_t capacity);

/* threads: 1 to 64, the caller's included; 0 for what the process may use. STREETFORWARD_CPU caps the instruction set. Results have
 * the same bits for every number of threads and every instruction set. */
sf_status sf_context_create(uint32_t threads, sf_context *out);
/* Rasters made from it stay usable. */
sf_status sf_context_destroy(sf_context context);

sf_status sf_raster_create(sf_context context, sf_raster *out);
sf_status sf_raster_destroy(sf_raster raster);

typedef struct sf_gaussians {
    size_t struct_size;
    uint64_t count;
    const float *mean;    /* [count, 3] centres, world axes */
    const float *scale;   /* [count, 3] standard deviations along the principal axes */
    const float *quat;    /* [count, 4] w, x, y, z; any length */
    const float *opacity; /* [count] 0..1 */
    const float *colour;  /* [count, 3] */
} sf_gaussians;

typedef struct sf_view {
    size_t struct_size;
    uint32_t width, height;     /* 1 to 16384 pixels */
    double fx, fy, cx, cy;      /* pixels, pixel centres at + 0.5 */
    double world_to_camera[16]; /* rows; x right, y down, z forward; last row 0 0 0 1 */
} sf_view;

typedef struct sf_splat_settings {
    size_t struct_size;
    int32_t antialiased;  /* 0 or 1 */
    float a_max;          /* largest alpha, in 0..1 without the ends */
    float eps2d;          /* low-pass, pixels squared, 0 to 100 */
    float near_z;         /* nearest z drawn, 1e-6 to 1e10 */
    float background[3];  /* behind everything */
    uint64_t max_entries; /* most pairs of Gaussian and 32x32 tile, 8 bytes each */
} sf_splat_settings;

/* The defaults, struct_size included: classic, 0.999, 0.3, 0.01, black, 2^26. */
sf_status sf_splat_settings_init(sf_splat_settings *settings);

/* What comes out; NULL for what is not wanted. */
typedef struct sf_image {
    size_t struct_size;
    uint64_t pixels; /* width * height */
    float *rgb;      /* [height, width, 3] sum of T alpha c, background included */
    float *depth;    /* [height, width] sum of T alpha z, not divided by alpha */
    float *alpha;    /* [height, width] 1 - T */
} sf_image;

/* dL/d of an image; NULL for zero. */
typedef struct sf_image_gradients {
    size_t struct_size;
    uint64_t pixels;    /* width * height of the last image */
    const float *rgb;   /* [height, width, 3] */
    const float *depth; /* [height, width] */
    const float *alpha; /* [height, width] */
} sf_image_gradients;

/* dL/d of the Gaussians and of the view; NULL for what is not wanted. Values are written, not added. */
typedef struct sf_gaussian_gradients {
    size_t struct_size;
    uint64_t count; /* of the last image */
    float *mean;    /* [count, 3] */
    float *scale;   /* [count, 3] */
    float *quat;    /* [count, 4] of the quaternions as given */
    float *opacity; /* [count] */
    float *colour;  /* [count, 3] */
    double *view;   /* [3, 4] of the first three rows of world_to_camera, as if all twelve numbers were free */
} sf_gaussian_gradients;

typedef struct sf_counts {
    size_t struct_size;
    uint64_t gaussians;     /* given */
    uint64_t visible;       /* that reach a pixel */
    uint64_t entries;       /* pairs of visible Gaussian and tile */
    uint64_t block_updates; /* pairs of Gaussian and 4x4 block that were composited */
    uint64_t dropped;       /* for what they hold: not finite, negative scale, zero quaternion */
    uint64_t clamped;       /* scale or opacity brought into range */
} sf_counts;

/* Draws. settings may be NULL for the defaults. The Gaussians are copied, and may change before the way back. */
sf_status sf_raster_forward(sf_raster raster, const sf_gaussians *gaussians, const sf_view *view,
                            const sf_splat_settings *settings, const sf_image *image);
/* Gradients of the image that this raster drew last. May be called again with other gradients. */
sf_status sf_raster_backward(sf_raster raster, const sf_image_gradients *image,
                             const sf_gaussian_gradients *gaussians);
/* Counts of the last image; set counts->struct_size before the call. */
sf_status sf_raster_counts(sf_raster raster, sf_counts *counts);

#ifdef __cplusplus
}
#endif

#endif
