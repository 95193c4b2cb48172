//! Small text on pictures: a bitmap font of 5x7 pixels, printable ASCII.

use crate::image_io::Rgb8;

/// Columns of a letter, and of a letter with its gap.
const GLYPH: i64 = 5;
const STEP: i64 = 6;
/// Rows of a letter without zoom.
pub const HEIGHT: u32 = 7;

/// From the space to the tilde; a byte a row from the top, bit 4 is the leftmost pixel.
#[rustfmt::skip]
const FONT: [u64; 95] = [
    0x00000000000000, 0x04040404040004, 0x0a0a0a00000000, //    !  "
    0x0a0a1f0a1f0a0a, 0x040f140e051e04, 0x18190204081303, // #  $  %
    0x0c12140815120d, 0x04040800000000, 0x02040808080402, // &  '  (
    0x08040202020408, 0x0004150e150400, 0x0004041f040400, // )  *  +
    0x000000000c0408, 0x0000001f000000, 0x00000000000c0c, // ,  -  .
    0x00010204081000, 0x0e11131519110e, 0x040c040404040e, // /  0  1
    0x0e11010204081f, 0x1f02040201110e, 0x02060a121f0202, // 2  3  4
    0x1f101e0101110e, 0x0608101e11110e, 0x1f010204080808, // 5  6  7
    0x0e11110e11110e, 0x0e11110f01020c, 0x000c0c000c0c00, // 8  9  :
    0x000c0c000c0408, 0x02040810080402, 0x00001f001f0000, // ;  <  =
    0x08040201020408, 0x0e110102040004, 0x0e11010d15150e, // >  ?  @
    0x0e1111111f1111, 0x1e11111e11111e, 0x0e11101010110e, // A  B  C
    0x1c12111111121c, 0x1f10101e10101f, 0x1f10101e101010, // D  E  F
    0x0e11101711110f, 0x1111111f111111, 0x0e04040404040e, // G  H  I
    0x0702020202120c, 0x11121418141211, 0x1010101010101f, // J  K  L
    0x111b1515111111, 0x11111915131111, 0x0e11111111110e, // M  N  O
    0x1e11111e101010, 0x0e11111115120d, 0x1e11111e141211, // P  Q  R
    0x0f10100e01011e, 0x1f040404040404, 0x1111111111110e, // S  T  U
    0x11111111110a04, 0x1111111515150a, 0x11110a040a1111, // V  W  X
    0x1111110a040404, 0x1f01020408101f, 0x0e08080808080e, // Y  Z  [
    0x00100804020100, 0x0e02020202020e, 0x040a1100000000, // \  ]  ^
    0x0000000000001f, 0x08040200000000, 0x00000e010f110f, // _  `  a
    0x1010161911111e, 0x00000e1010110e, 0x01010d1311110f, // b  c  d
    0x00000e111f100e, 0x0609081c080808, 0x000f11110f010e, // e  f  g
    0x10101619111111, 0x04000c0404040e, 0x0200060202120c, // h  i  j
    0x10101214181412, 0x0c04040404040e, 0x00001a15151111, // k  l  m
    0x00001619111111, 0x00000e1111110e, 0x00001e111e1010, // n  o  p
    0x00000d130f0101, 0x00001619101010, 0x00000e100e011e, // q  r  s
    0x08081c08080906, 0x0000111111130d, 0x00001111110a04, // t  u  v
    0x0000111115150a, 0x0000110a040a11, 0x000011110f010e, // w  x  y
    0x00001f0204081f, 0x02040408040402, 0x04040404040404, // z  {  |
    0x08040402040408, 0x00000815020000, // }  ~
];

/// Pixels that a text is wide.
pub fn width(text: &str, zoom: u32) -> u32 {
    (text.chars().count() as u32 * STEP as u32).saturating_sub(1) * zoom
}

/// Writes a text with its upper left corner at `(x, y)`, every font pixel `zoom` wide; what lies outside the
/// picture is cut off. A character that the font lacks is a question mark.
pub fn draw(image: &mut Rgb8, (x, y): (i64, i64), text: &str, colour: [u8; 3], zoom: u32) {
    let (w, h, zoom) = (i64::from(image.width), i64::from(image.height), i64::from(zoom.max(1)));
    for (n, c) in text.chars().enumerate() {
        let known = if (' '..='~').contains(&c) { c } else { '?' };
        let rows = FONT[known as usize - ' ' as usize];
        let left = x + n as i64 * STEP * zoom;
        for row in 0..i64::from(HEIGHT) * zoom {
            for column in 0..GLYPH * zoom {
                let bit = 8 * (i64::from(HEIGHT) - 1 - row / zoom) + (GLYPH - 1 - column / zoom);
                let (px, py) = (left + column, y + row);
                if rows >> bit & 1 == 1 && (0..w).contains(&px) && (0..h).contains(&py) {
                    let at = 3 * (py * w + px) as usize;
                    image.data[at..at + 3].copy_from_slice(&colour);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The picture as rows of dots.
    fn dots(image: &Rgb8) -> Vec<String> {
        let row = |y| (0..image.width).map(|x| if image.pixel(x, y) == [0; 3] { '.' } else { '#' }).collect();
        (0..image.height).map(row).collect()
    }

    #[test]
    fn letters_look_like_themselves() {
        let mut image = Rgb8::new(11, 7, vec![0; 3 * 77]);
        draw(&mut image, (0, 0), "R2", [255; 3], 1);
        let want =
            ["####...###.", "#...#.#...#", "#...#.....#", "####.....#.", "#.#.....#..", "#..#...#...", "#...#.#####"];
        assert_eq!(dots(&image), want);
        assert_eq!((width("R2", 1), width("R2", 3), width("", 1)), (11, 33, 0));
    }

    #[test]
    fn every_printable_letter_is_its_own_and_five_wide() {
        let mut seen = std::collections::BTreeSet::new();
        for rows in FONT {
            assert!(rows.to_be_bytes().iter().all(|&b| b < 32), "{rows:x}");
            assert!(seen.insert(rows), "{rows:x} twice");
        }
    }

    #[test]
    fn text_is_cut_off_at_the_edges_and_zoomed() {
        let mut image = Rgb8::new(4, 4, vec![0; 48]);
        draw(&mut image, (-3, -2), "WWW", [9, 8, 7], 2);
        draw(&mut image, (1000, 1000), "x", [1; 3], 1);
        draw(&mut image, (0, 0), "\u{e9}", [9, 8, 7], 1);
        assert!(image.data.chunks(3).any(|p| p == [9, 8, 7]));
        let mut large = Rgb8::new(10, 14, vec![0; 420]);
        draw(&mut large, (0, 0), "T", [255; 3], 2);
        assert_eq!(dots(&large)[..4], ["##########", "##########", "....##....", "....##...."]);
    }
}
