//! The HTML report: one file with denoised, noisy, reference and baseline images, and all scores.
//!
//! The page consists of `page.html`, `style.css`, the scripts, and the numbers as JSON. Each
//! scene's pictures are separate JSON, parsed when the scene is selected. Names go through JSON and
//! `textContent`, never through HTML. A content security policy forbids network access.

mod codec;
mod error_map;
mod views;

use demc_model::metrics::METRICS;
use serde::Serialize;
use serde_json::json;

use crate::evaluate::{ImageScore, Report};
use crate::statistics::FEWEST_BASES;
pub use views::{EncodedScene, ReportError, SceneImages};

const TEMPLATE: &str = include_str!("page.html");
const STYLE: &str = include_str!("style.css");
const SCRIPTS: [&str; 4] = [
    include_str!("dom.js"),
    include_str!("viewer.js"),
    include_str!("tables.js"),
    include_str!("charts.js"),
];

/// The subject of a report.
#[derive(Debug, Clone, Serialize)]
pub struct About {
    /// The model behind the denoised images.
    pub model: String,
    /// The data set.
    pub data: String,
    /// The data set's split.
    pub split: String,
}

/// A report under construction. Holds only encoded pictures.
#[derive(Default)]
pub struct ReportPage {
    images: Vec<serde_json::Value>,
    pictures: Vec<String>,
}

impl ReportPage {
    /// Adds a scene's pictures and its `score`.
    ///
    /// # Errors
    /// [`ReportError::Json`].
    pub fn add(&mut self, encoded: EncodedScene, score: &ImageScore) -> Result<(), ReportError> {
        self.images.push(json!({
            "name": score.name,
            "width": encoded.width,
            "height": encoded.height,
            "residual": score.reference_residual,
            "scores": by_name(&score.methods())?,
            "thumbnail": encoded.thumbnail,
            "block": encoded.block,
            "quality": encoded.quality,
        }));
        self.pictures.push(script_json(&encoded.pictures)?);
        Ok(())
    }

    /// The HTML file, with the scores of `report`.
    ///
    /// # Errors
    /// [`ReportError::Json`].
    pub fn html(&self, about: &About, report: &Report) -> Result<String, ReportError> {
        let metrics = METRICS.iter().map(|metric| {
            json!({
                "name": metric.name,
                "definition": metric.definition,
                "better": metric.better.word(),
            })
        });
        let methods = report.mean.methods();
        let names: Vec<&str> = methods.iter().map(|(name, _)| *name).collect();
        let data = json!({
            "about": about,
            "version": env!("CARGO_PKG_VERSION"),
            "metrics": metrics.collect::<Vec<_>>(),
            "methods": names,
            "images": self.images,
            "failed": report.failed,
            "mean": by_name(&methods)?,
            "differences": report.differences(),
            "fewestBases": FEWEST_BASES,
            "curve": { "white": codec::WHITE, "toe": codec::TOE },
            "errorScale": error_map::SCALE,
        });
        let mut json = element("data", &script_json(&data)?);
        for (i, pictures) in self.pictures.iter().enumerate() {
            json += &element(&format!("pictures-{i}"), pictures);
        }
        let parts = [
            ("{{style}}", STYLE),
            ("{{json}}", &json),
            ("{{script}}", &SCRIPTS.join("\n")),
        ];
        Ok(filled(TEMPLATE, &parts))
    }
}

fn by_name(methods: &[(&str, &crate::Score)]) -> Result<serde_json::Value, serde_json::Error> {
    let scores = methods.iter().map(|(name, score)| {
        let score = serde_json::to_value(score)?;
        Ok(((*name).to_owned(), score))
    });
    Ok(serde_json::Value::Object(scores.collect::<Result<_, _>>()?))
}

/// JSON that cannot end its script element.
fn script_json(value: &impl Serialize) -> Result<String, serde_json::Error> {
    Ok(serde_json::to_string(value)?.replace('<', "\\u003c"))
}

fn element(id: &str, json: &str) -> String {
    format!("<script type=\"application/json\" id=\"{id}\">{json}</script>\n")
}

/// The template with each mark replaced, in the order of the marks. Marks in inserted text are
/// ignored.
fn filled(template: &str, parts: &[(&str, &str)]) -> String {
    let mut rest = template;
    let mut out = String::new();
    for (mark, text) in parts {
        let (before, after) = rest.split_once(mark).expect("the template has every mark");
        out += before;
        out += text;
        rest = after;
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_end_their_script_element() {
        let mut frame = crate::bundle::testing::frame(60, 50);
        frame.reference = Some(frame.color.iter().map(|x| x + 0.1).collect());
        frame.name = "</script><script>alert(1)</script>{{script}}".into();
        let planes = frame.color.clone();
        let baselines = [("<b>&amp;", planes.as_slice())];
        let score = ImageScore::full(&frame, &planes, &baselines, None).expect("scored");
        let views = SceneImages {
            frame: &frame,
            denoised: &planes,
            baselines: &baselines,
        };
        let mut page = ReportPage::default();
        page.add(views.encode(1).expect("encoded"), &score)
            .expect("added");
        let about = About {
            model: "<!-- model".into(),
            data: "data".into(),
            split: "test".into(),
        };
        let html = page
            .html(&about, &Report::new(vec![score]))
            .expect("a page");
        let ends = |text: &str| text.matches("</script").count();
        assert_eq!(ends(&html), ends(TEMPLATE) + 2);
        assert!(!html.contains("<b>&amp;") && !html.contains("<!-- model"));
        assert!(html.contains("\\u003c/script>\\u003cscript>alert(1)\\u003c/script>{{script}}"));
        let start = html.find("id=\"data\">").expect("numbers") + "id=\"data\">".len();
        let end = start + html[start..].find("</script").expect("an end");
        let data: serde_json::Value = serde_json::from_str(&html[start..end]).expect("JSON");
        assert_eq!(data["images"][0]["name"], frame.name);
        assert_eq!(
            data["methods"],
            json!(["noisy", "black", "<b>&amp;", "denoised"])
        );
    }

    #[test]
    fn images_that_cannot_be_compared_are_refused() {
        let mut frame = crate::bundle::testing::frame(50, 44);
        let planes = frame.color.clone();
        let mut bad = planes.clone();
        bad[3] = f32::NAN;
        let encode = |frame: &demc_data::Frame, denoised: &[f32]| {
            let views = SceneImages {
                frame,
                denoised,
                baselines: &[],
            };
            views.encode(1).map(|_| ()).map_err(|e| e.to_string())
        };
        let no_reference = encode(&frame, &planes).expect_err("no reference");
        assert_eq!(no_reference, "pattern: no reference in the file");
        frame.reference = Some(planes.clone());
        let error = encode(&frame, &bad).expect_err("NaN");
        assert_eq!(error, "pattern: denoised");
        assert_eq!(encode(&frame, &planes), Ok(()));
    }
}
