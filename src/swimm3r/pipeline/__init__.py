"""From a video to a report: the stages of a run, their record, and the scores of the result."""
