//! Borrowed views: row-major matrices with a row stride, and dense channels-last images.
//!
//! `Mat` element (r, c) lies at `data[r * stride + c]`; `Hwc` element (y, x, ch) at
//! `data[(y * w + x) * c + ch]`. Constructors check the lengths once, so that the ops may index freely.

/// Read-only `[rows, cols]` matrix.
#[derive(Clone, Copy, Debug)]
pub struct Mat<'a> {
    /// Values; at least `(rows - 1) * stride + cols` of them.
    pub data: &'a [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance between the starts of two rows, at least `cols`.
    pub stride: usize,
}

/// Writable `[rows, cols]` matrix.
#[derive(Debug)]
pub struct MatMut<'a> {
    /// Values; at least `(rows - 1) * stride + cols` of them.
    pub data: &'a mut [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance between the starts of two rows, at least `cols`.
    pub stride: usize,
}

/// Values that a `[rows, cols]` view with this stride spans.
fn span(rows: usize, cols: usize, stride: usize) -> usize {
    assert!(stride >= cols, "row stride {stride} is less than {cols} columns");
    if rows == 0 { 0 } else { (rows - 1) * stride + cols }
}

impl<'a> Mat<'a> {
    /// Dense `[rows, cols]` over exactly `rows * cols` values.
    pub fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a dense {rows} x {cols} matrix");
        Self { data, rows, cols, stride: cols }
    }

    /// Rows `stride` values apart.
    pub fn with_stride(data: &'a [f32], rows: usize, cols: usize, stride: usize) -> Self {
        let need = span(rows, cols, stride);
        assert!(data.len() >= need, "{} values for {rows} x {cols}, stride {stride}: {need} needed", data.len());
        Self { data, rows, cols, stride }
    }

    /// Row `r`.
    #[inline]
    pub fn row(&self, r: usize) -> &'a [f32] {
        &self.data[r * self.stride..][..self.cols]
    }

    /// Rows `first..first + rows`.
    pub fn rows_at(&self, first: usize, rows: usize) -> Mat<'a> {
        assert!(first + rows <= self.rows, "rows {first}..{} of {}", first + rows, self.rows);
        Mat::with_stride(&self.data[(first * self.stride).min(self.data.len())..], rows, self.cols, self.stride)
    }

    /// Columns `first..first + cols` of every row.
    pub fn cols_at(&self, first: usize, cols: usize) -> Mat<'a> {
        assert!(first + cols <= self.cols, "columns {first}..{} of {}", first + cols, self.cols);
        Mat::with_stride(&self.data[first.min(self.data.len())..], self.rows, cols, self.stride)
    }
}

impl<'a> MatMut<'a> {
    /// Dense `[rows, cols]` over exactly `rows * cols` values.
    pub fn new(data: &'a mut [f32], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a dense {rows} x {cols} matrix");
        Self { data, rows, cols, stride: cols }
    }

    /// Rows `stride` values apart.
    pub fn with_stride(data: &'a mut [f32], rows: usize, cols: usize, stride: usize) -> Self {
        let need = span(rows, cols, stride);
        assert!(data.len() >= need, "{} values for {rows} x {cols}, stride {stride}: {need} needed", data.len());
        Self { data, rows, cols, stride }
    }

    /// Row `r`.
    #[inline]
    pub fn row_mut(&mut self, r: usize) -> &mut [f32] {
        &mut self.data[r * self.stride..][..self.cols]
    }

    /// The same matrix, read-only.
    pub fn as_mat(&self) -> Mat<'_> {
        Mat { data: self.data, rows: self.rows, cols: self.cols, stride: self.stride }
    }

    /// A shorter borrow of the same matrix.
    pub fn reborrow(&mut self) -> MatMut<'_> {
        MatMut { data: self.data, rows: self.rows, cols: self.cols, stride: self.stride }
    }
}

/// Read-only dense image `[h, w, c]`.
#[derive(Clone, Copy, Debug)]
pub struct Hwc<'a> {
    /// Exactly `h * w * c` values.
    pub data: &'a [f32],
    /// Height.
    pub h: usize,
    /// Width.
    pub w: usize,
    /// Channels.
    pub c: usize,
}

/// Writable dense image `[h, w, c]`.
#[derive(Debug)]
pub struct HwcMut<'a> {
    /// Exactly `h * w * c` values.
    pub data: &'a mut [f32],
    /// Height.
    pub h: usize,
    /// Width.
    pub w: usize,
    /// Channels.
    pub c: usize,
}

impl<'a> Hwc<'a> {
    /// Over exactly `h * w * c` values.
    pub fn new(data: &'a [f32], h: usize, w: usize, c: usize) -> Self {
        assert_eq!(data.len(), h * w * c, "a {h} x {w} x {c} image");
        Self { data, h, w, c }
    }

    /// Channels of pixel (y, x).
    #[inline]
    pub fn pixel(&self, y: usize, x: usize) -> &'a [f32] {
        &self.data[(y * self.w + x) * self.c..][..self.c]
    }

    /// As a `[h * w, c]` matrix.
    pub fn as_mat(&self) -> Mat<'a> {
        Mat::new(self.data, self.h * self.w, self.c)
    }
}

impl<'a> HwcMut<'a> {
    /// Over exactly `h * w * c` values.
    pub fn new(data: &'a mut [f32], h: usize, w: usize, c: usize) -> Self {
        assert_eq!(data.len(), h * w * c, "a {h} x {w} x {c} image");
        Self { data, h, w, c }
    }

    /// The same image, read-only.
    pub fn as_hwc(&self) -> Hwc<'_> {
        Hwc { data: self.data, h: self.h, w: self.w, c: self.c }
    }
}
