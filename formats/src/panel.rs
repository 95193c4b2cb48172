//! Order of a matrix's weights in a blob: panels of 16 outputs.
//!
//! A weight is a matrix of n outputs by k inputs ([`TensorSpec::matrix`]). Layout K1N16 cuts the
//! outputs into panels of [`LANES`]; inside a panel the values of one input stand together:
//!
//! ```text
//! position of (n, k) = ((n / 16) * K + k) * 16 + n % 16
//! ```
//!
//! The last panel is filled up with zeros. Convolutions order k as `[ky][kx][in]` (an im2row line of a
//! channels-last image), transposed convolutions with stride = kernel order n as `[ky][kx][out]`.

use crate::arch::{Role, TensorSpec};

/// Outputs per panel: one cache line of f32.
pub const LANES: usize = 16;

/// Where the values of a matrix stand in the checkpoint: value (n, k) is at `rows[n] + columns[k]`.
#[derive(Clone, Debug)]
pub struct Order {
    rows: Vec<usize>,
    columns: Vec<usize>,
}

impl Order {
    /// Of a tensor; `None` for vectors and tables.
    pub fn of(spec: &TensorSpec) -> Option<Order> {
        let (n, k) = spec.matrix()?;
        let s = &spec.shape;
        let (rows, columns) = match spec.role {
            Role::Conv => {
                let (inputs, area) = (s[1], s[2] * s[3]);
                // k = pixel * inputs + input; the checkpoint has [out][in][ky][kx].
                ((0..n).map(|o| o * inputs * area).collect(), (0..k).map(|k| k % inputs * area + k / inputs).collect())
            }
            Role::ConvTranspose => {
                let (outputs, area) = (s[1], s[2] * s[3]);
                // n = pixel * outputs + output; the checkpoint has [in][out][ky][kx].
                (
                    (0..n).map(|n| n % outputs * area + n / outputs).collect(),
                    (0..k).map(|i| i * outputs * area).collect(),
                )
            }
            _ => ((0..n).map(|o| o * k).collect(), (0..k).collect()),
        };
        Some(Order { rows, columns })
    }

    /// Place of value (output, input) in the checkpoint.
    pub fn at(&self, o: usize, i: usize) -> usize {
        self.rows[o] + self.columns[i]
    }

    /// Number of panels.
    pub fn panels(&self) -> usize {
        self.rows.len().div_ceil(LANES)
    }

    /// Values in one panel, k * 16.
    pub fn panel_len(&self) -> usize {
        self.columns.len() * LANES
    }

    /// Copies panel `p` out of checkpoint order into `panel`, `[k][16]`.
    pub fn pack(&self, p: usize, values: &[f32], panel: &mut [f32]) {
        assert_eq!(panel.len(), self.panel_len(), "panel length");
        assert_eq!(values.len(), self.rows.len() * self.columns.len(), "matrix length");
        let rows = &self.rows[p * LANES..self.rows.len().min((p + 1) * LANES)];
        for (line, &column) in panel.chunks_exact_mut(LANES).zip(&self.columns) {
            for (lane, &row) in line.iter_mut().zip(rows) {
                *lane = values[row + column];
            }
            line[rows.len()..].fill(0.0);
        }
    }

    /// The reverse of [`Order::pack`].
    pub fn unpack(&self, p: usize, panel: &[f32], values: &mut [f32]) {
        assert_eq!(panel.len(), self.panel_len(), "panel length");
        assert_eq!(values.len(), self.rows.len() * self.columns.len(), "matrix length");
        let rows = &self.rows[p * LANES..self.rows.len().min((p + 1) * LANES)];
        for (line, &column) in panel.chunks_exact(LANES).zip(&self.columns) {
            for (&lane, &row) in line.iter().zip(rows) {
                values[row + column] = lane;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(shape: &[usize], role: Role) -> TensorSpec {
        TensorSpec { name: "t".into(), shape: shape.to_vec(), role }
    }

    /// Every value of every kind of matrix, against the definition written out with explicit indices.
    #[test]
    fn panels_follow_the_definition() {
        // The checkpoint index of output (o), input (i), kernel pixel (y, x).
        let conv = |s: &[usize], o, i, y, x| ((o * s[1] + i) * s[2] + y) * s[3] + x;
        for (o, i, kh, kw) in [(1, 1, 1, 1), (5, 3, 2, 4), (16, 2, 3, 3), (17, 1, 1, 2), (33, 4, 3, 1)] {
            for role in [Role::Linear, Role::Conv, Role::ConvTranspose] {
                let shape = match role {
                    Role::Linear => vec![o, i * kh * kw],
                    Role::Conv => vec![o, i, kh, kw],
                    _ => vec![i, o, kh, kw],
                };
                let spec = spec(&shape, role);
                let (n, k) = spec.matrix().unwrap();
                let values: Vec<f32> = (0..n * k).map(|v| v as f32 + 1.0).collect();
                let order = Order::of(&spec).unwrap();
                let mut packed = vec![-1.0; order.panels() * order.panel_len()];
                for (p, panel) in packed.chunks_exact_mut(order.panel_len()).enumerate() {
                    order.pack(p, &values, panel);
                }
                let at = |n: usize, c: usize| packed[(n / 16 * k + c) * 16 + n % 16];
                for y in 0..kh {
                    for x in 0..kw {
                        for i in 0..i {
                            for o in 0..o {
                                let (got, index) = match role {
                                    Role::Linear => {
                                        let c = (i * kh + y) * kw + x;
                                        (at(o, c), o * k + c)
                                    }
                                    Role::Conv => (at(o, (y * kw + x) * shape[1] + i), conv(&shape, o, i, y, x)),
                                    _ => (at((y * kw + x) * shape[1] + o, i), conv(&shape, i, o, y, x)),
                                };
                                assert_eq!(got, values[index], "{role:?} {shape:?} o {o} i {i} y {y} x {x}");
                            }
                        }
                    }
                }
                for n in n..order.panels() * 16 {
                    assert!((0..k).all(|c| at(n, c) == 0.0), "padding of {shape:?}");
                }
                let mut back = vec![0.0; n * k];
                for (p, panel) in packed.chunks_exact(order.panel_len()).enumerate() {
                    order.unpack(p, panel, &mut back);
                }
                assert_eq!(back, values);
            }
        }
    }

    #[test]
    fn vectors_have_no_panels() {
        assert!(Order::of(&spec(&[7], Role::Bias)).is_none());
        assert!(Order::of(&spec(&[1, 4, 8], Role::Table)).is_none());
    }
}
