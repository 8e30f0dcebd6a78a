"""Navigation of vehicles: CSV, NMEA, Matisse .dim2, TUM, EXIF GPS and .srt files to one record."""
